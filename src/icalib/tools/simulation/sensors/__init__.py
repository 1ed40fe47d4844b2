"""What each sensor measures, by the obvious formula."""

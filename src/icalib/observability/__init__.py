"""What the data determine, and what they do not."""

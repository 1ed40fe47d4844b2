"""Tables of text: columns, and what each sensor has in them."""

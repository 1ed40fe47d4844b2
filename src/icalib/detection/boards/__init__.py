"""One file for each kind of target: from a grey image to its corners."""

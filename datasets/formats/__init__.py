"""The content of a file as arrays and numbers, or one error that names it: a kind of content a file."""

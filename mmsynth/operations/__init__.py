"""What is made of a field, a folder each."""

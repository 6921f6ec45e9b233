"""What is made of a field, a folder each; ``output`` and ``views`` are shared by the others."""

"""The surface as a mesh, with every modality on it.

Start with ``extract``.
"""

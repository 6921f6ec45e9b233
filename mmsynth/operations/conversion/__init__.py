"""One modality into another.

Start with ``methods`` (tensors and single frames); ``files`` converts the frames of a scene on disk.
"""

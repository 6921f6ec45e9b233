"""One modality into another.

Start with ``methods`` (tensors and single frames); ``files`` converts frames on disk, ``register`` finds the pose of frames that have none.
"""

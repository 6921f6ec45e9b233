"""One modality into another.

Start with ``methods`` (tensors and single frames); ``predictions`` has what each method says, ``evidence`` how much of each ``auto`` takes,
``moving_light`` whether a light moves with its camera. ``files`` converts frames on disk, ``register`` finds the pose of frames that have
none.
"""

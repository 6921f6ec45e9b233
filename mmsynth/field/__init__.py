"""What the scene is: a signed distance field and its radiance.

Start with ``field`` (``Field.render``); ``kernels`` computes it on CPU and GPU.
"""

"""What scenes have in common: what light in some channels, and the shape of a surface, say of light in others.

Start reading at ``prior.py``: a ``Prior`` is learned from samples of several fields (``learn_prior``), and read and written as one file.
``prediction.py`` makes of it what one scene needs: the modalities that nobody measured there, with their deviations.
"""

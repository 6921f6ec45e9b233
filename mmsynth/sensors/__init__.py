"""How a sensor measures light: functions on torch tensors, batched and differentiable.

Start with ``camera`` (rays and pixels), ``mosaic`` and ``polarization``; ``twin`` puts all effects of a sensor together.
``modules`` stand in ``nn.Sequential`` and kornia's pipelines.
"""

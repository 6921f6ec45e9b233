"""How a field is learned from raw frames.

Start with ``trainer``; ``recipe`` has every number that can be chosen, ``needs`` what a scene asks for.
"""

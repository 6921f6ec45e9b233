"""A scene, or a run's scene with the poses that the fit corrected, in the layouts of other tools.

``export.export_scene`` plans, copies and writes; what each layout holds is in ``plans``. ``demosaicked`` writes the copy that other methods
learn from, to be compared with.
"""

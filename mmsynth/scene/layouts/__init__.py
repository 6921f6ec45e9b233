"""One module for each layout of scenes and of poses on disk; each converts to the conventions of ``scene.scene``."""

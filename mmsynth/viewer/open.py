"""Open a field in the browser."""

from __future__ import annotations

from pathlib import Path

from mmsynth.field.field import Field
from mmsynth.scene.scene import Scene
from mmsynth.viewer.panels import add_panels
from mmsynth.viewer.viewer import Viewer


def open_viewer(
    field: Field, scene: Scene | None, folder: Path, *, host: str = "127.0.0.1", port: int = 8080, live: bool = False
) -> Viewer:
    """Listen for browsers at ``viewer.url``; ``serve`` it, or call its ``work`` now and then.

    Args:
        scene: the one that the field was fitted to; None: it is gone, and no frames are shown. folder: of the run, for paths and videos.
        live: of a fit that goes on: pictures are small, and ``glance`` shows how the field changes.
    Raises:
        InputError: viser is not installed, or the port is taken.
    """
    return Viewer(field, scene, folder, host=host, port=port, live=live, add_panels=add_panels)


def serve(viewer: Viewer) -> None:
    """Until the terminal's user has enough of it (KeyboardInterrupt)."""
    try:
        while True:
            if not viewer.work(0.5):
                viewer.wait(0.5)
    finally:
        viewer.close()

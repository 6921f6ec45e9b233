"""Commands that show a field: view, video."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mmsynth.cli.arguments import DeviceOption, JsonOption, RunOption
from mmsynth.cli.terminal import command, progress_bar

if TYPE_CHECKING:
    from mmsynth.field.field import Field
    from mmsynth.scene.scene import Scene
    from mmsynth.viewer.viewer import Viewer

PortOption = Annotated[int, typer.Option(min=1, max=65535, help="where the browser finds it")]
HostOption = Annotated[str, typer.Option(help="address to listen at; default: this machine alone")]


@command("view")
def view(run: RunOption = None, port: PortOption = 8080, host: HostOption = "127.0.0.1", device: DeviceOption = "auto") -> None:
    """Look at a field in the browser; ctrl-c ends it."""
    from mmsynth.errors import InputError
    from mmsynth.fitting.device import pick_device
    from mmsynth.viewer.open import open_viewer, serve
    from mmsynth.viewer.viewer import require_free
    from mmsynth.workflows.runs import open_field, open_run

    require_free(host, port)
    chosen = pick_device(device)
    try:
        opened = open_run(run, device=chosen)
        folder, field, scene = opened.folder, opened.field, opened.scene
    except InputError as error:
        folder, field = open_field(run, device=chosen)  # the field can be looked at without its scene
        scene = None
        print(f"note: {error} The field is shown without its frames.")
    viewer = open_viewer(field, scene, folder, host=host, port=port)
    print(listening(viewer.url, host), flush=True)
    serve(viewer)


def listening(url: str, host: str) -> str:
    """What is said of a viewer that listens."""
    alone = host in ("127.0.0.1", "localhost", "::1")
    who = (
        "this machine alone can see it" if alone else f"whoever reaches {host} can see the run and steer this program: there is no password"
    )
    return f"{url} ({who}; ctrl-c ends it)"


class LiveView:
    """What shows the field of a fit while it is learned: called after every step."""

    def __init__(self, scene: Scene, port: int, say: Callable[[str], None]) -> None:
        self._scene, self._port, self._say = scene, port, say
        self._viewer: Viewer | None = None

    def __call__(self, folder: Path, field: Field) -> None:
        from mmsynth.viewer.open import open_viewer

        if self._viewer is None:
            self._viewer = open_viewer(field, self._scene, folder, port=self._port, live=True)
            self._say(listening(self._viewer.url, self._viewer.host))
        self._viewer.glance()

    def close(self) -> None:
        """Disconnect the browsers."""
        if self._viewer is not None:
            self._viewer.close()


@command("video")
def video(
    poses: Annotated[Path, typer.Option(help="as for generate-dataset; every pose is a picture")] = Path("poses.json"),
    show: Annotated[
        str, typer.Option(help="what is shown, beside each other: modalities, channels (ms:5, ms:530nm, 550nm, ms:7/nir:0/ms:1), s0, dolp, "
                               "aolp, depth, normals, opacity, coverage, diffuse, specular, NAME:deviation")
    ] = "rgb",
    run: RunOption = None,
    fps: Annotated[float, typer.Option(min=0.1, max=240.0, help="pictures a second")] = 24.0,
    width: Annotated[int | None, typer.Option(min=16, max=16384, help="pixels of a row; default: as the poses' cameras have them")] = None,
    out: Annotated[Path | None, typer.Option(help="default: RUN/videos/POSES.mp4")] = None,
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:  # fmt: skip
    """Film a path through a field."""
    from mmsynth.fitting.device import pick_device
    from mmsynth.operations.views.displays import find_display
    from mmsynth.operations.views.video import write_video
    from mmsynth.workflows.runs import open_run

    opened = open_run(run, device=pick_device(device))
    names = [find_display(opened.field, name).name for name in show.split(",") if name.strip()]
    destination = out or opened.folder / "videos" / f"{poses.stem}.mp4"
    with progress_bar("video", as_json) as bar:
        count = write_video(opened.field, poses, destination, names, fps, width=width, scene=opened.scene, progress=bar)
    if as_json:
        print(json.dumps({"out": str(destination), "pictures": count, "show": names}))
    else:
        print(f"wrote {destination} ({count} pictures, {count / fps:.1f} s)")

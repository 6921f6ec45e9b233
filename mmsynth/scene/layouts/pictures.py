"""The image files that the metadata of a layout name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path, PurePosixPath

from mmsynth.errors import InputError
from mmsynth.scene.checks import is_file
from mmsynth.scene.images import SUFFIXES, image_size
from mmsynth.sensors.camera import Camera


class Pictures:
    """Where the pictures of a scene are.

    A name without a known suffix stands for the file with one. Where the owner of the data says that all of them are in another folder
    than the metadata tell, a picture is what has its name there, with its subfolders or without, and with any suffix.

    Args:
        root: what names are relative to. elsewhere: the folder where they are instead, None: where the names say.
    Raises:
        InputError: ``elsewhere`` is no folder.
    """

    def __init__(self, root: Path, elsewhere: Path | None = None) -> None:
        if elsewhere is not None and not elsewhere.is_dir():
            raise InputError(f"{elsewhere}: no such folder, expected the one with the pictures.")
        self.root, self.elsewhere = root, elsewhere
        self._listed: dict[Path, dict[str, Path]] = {}
        self._names: dict[Path, str] = {}

    def find(self, name: str) -> Path | None:
        """The file of a picture; None where there is none.

        Raises:
            InputError: two names would stand for one file, because the pictures are not in the subfolders of their names.
        """
        if self.elsewhere is not None:
            found = self._elsewhere(name, self.elsewhere)
            if found is not None and self._names.setdefault(found, name) != name:
                raise InputError(f"{found}: stands for '{self._names[found]}' and '{name}', expected a picture for each, in subfolders.")
            return found
        path = self.root / name
        if path.suffix.lower() in SUFFIXES:
            return path if is_file(path) else None
        return self._of_any_suffix(path)

    def _elsewhere(self, name: str, folder: Path) -> Path | None:
        """By the whole name, else without its first folder, and so on down to the file's own name."""
        parts = PurePosixPath(name).parts
        for first in range(len(parts)):
            if parts[first] not in ("/", "..") and (found := self._of_any_suffix(folder.joinpath(*parts[first:]))):
                return found
        return None

    def _of_any_suffix(self, path: Path) -> Path | None:
        if path.suffix.lower() in SUFFIXES and is_file(path):
            return path
        folder = path.parent
        if folder not in self._listed:
            self._listed[folder] = _by_stem(folder)
        return self._listed[folder].get(without_suffix(path).name)


def _by_stem(folder: Path) -> dict[str, Path]:
    """The image files of a folder, by their names without suffix."""
    try:
        files = [file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and is_file(file)]
    except (OSError, ValueError):  # there is none, or a name that no folder can have
        return {}
    files.sort(key=lambda file: SUFFIXES.index(file.suffix.lower()), reverse=True)
    return {without_suffix(file).name: file for file in files}


def without_suffix(path: Path) -> Path:
    """The path without the suffix of an image file: what follows another dot belongs to the name."""
    return path.with_suffix("") if path.suffix.lower() in SUFFIXES else path


def fitted_to(camera: Camera, size: tuple[int, int], where: str) -> Camera:
    """The camera of a picture whose width and height are not those that the metadata state, because it was reduced or enlarged as a whole.

    Each side may be off by a pixel, as rounding leaves it.

    Raises:
        InputError: the sides do not have one ratio.
    """
    if size == (camera.width, camera.height):
        return camera
    x, y = size[0] / camera.width, size[1] / camera.height
    if abs(x - y) * min(camera.width, camera.height) > 1.0 + 1e-9:
        raise InputError(
            f"{where}: the picture is {size[0]}x{size[1]} pixels, expected {camera.width}x{camera.height} as its camera says, "
            "or both sides reduced by one ratio."
        )
    return replace(
        camera,
        width=size[0],
        height=size[1],
        fx=camera.fx * x,
        fy=camera.fy * y,
        cx=(camera.cx + 0.5) * x - 0.5,
        cy=(camera.cy + 0.5) * y - 0.5,
    )


class Resizes:
    """The cameras of pictures that may have another size than the metadata state, and what there is to say of them."""

    def __init__(self, where: str) -> None:
        self.where = where
        self._ratios: list[float] = []
        self._last: tuple[int, int] | None = None

    def size_of(self, file: Path) -> tuple[int, int]:
        """Width and height; of a damaged file those of the one before, because the damage is said when it is read."""
        try:
            self._last = image_size(file)
        except InputError:
            if self._last is None:
                raise
        return self._last

    def fitted(self, camera: Camera, file: Path) -> Camera:
        """``fitted_to`` the size of the file."""
        fitted = fitted_to(camera, self.size_of(file), str(file))
        if fitted is not camera:
            self._ratios.append(fitted.width / camera.width)
        return fitted

    def problems(self) -> list[str]:
        """One sentence, if there were any."""
        if not self._ratios:
            return []
        low, high = (f"{value:.4g}" for value in (min(self._ratios), max(self._ratios)))
        by = low if low == high else f"{low} to {high}"
        return [f"{self.where}: {len(self._ratios)} pictures have {by} times the size that it states; their cameras are scaled."]

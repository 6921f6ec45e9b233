"""Calibration boards as ``board.toml`` describes them, and where their corners lie.

One board at the top level of the file, or several as ``[[board]]``:

    kind = "charuco"             # "charuco", "chessboard" or "circles"
    squares = [5, 7]             # columns and rows of squares; of circles: how many in a row and in a column
    square = 0.036               # side of a square, or from circle to circle, in metres
    marker = 0.027               # side of a marker (ChArUco)
    dictionary = "DICT_4X4_100"  # of the markers (ChArUco)
    first_id = 0                 # of the markers (ChArUco)
    inverted = false             # white and black are exchanged
    asymmetric = false           # every second row of circles is moved by one place: OpenCV's asymmetric grid
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from mmsynth.errors import InputError
from mmsynth.toml import read_toml

Count = Annotated[int, Field(ge=2, le=100)]
Length = Annotated[float, Field(gt=0, lt=100, allow_inf_nan=False)]


class Board(BaseModel):
    """A calibration board; the keys are those of the module's docstring. Hashable."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["charuco", "chessboard", "circles"]
    squares: tuple[Count, Count]
    square: Length
    marker: Length | None = None
    dictionary: str = "DICT_4X4_100"
    first_id: Annotated[int, Field(ge=0)] = 0
    inverted: bool = False
    asymmetric: bool = False

    @model_validator(mode="after")
    def _fits(self) -> Board:
        columns, rows = self.squares
        if self.kind != "circles" and self.asymmetric:
            raise ValueError(f"asymmetric: a grid of circles can be, a {self.kind} board cannot")
        if self.kind == "chessboard" and min(columns, rows) < 4:
            raise ValueError(f"squares: {columns}x{rows} of a chessboard, expected at least 4x4 (3x3 inner corners)")
        if self.kind != "charuco":
            unused = {"marker", "dictionary", "first_id"} & self.model_fields_set
            if unused:
                raise ValueError(f"{sorted(unused)[0]}: a {self.kind} board has no markers")
            return self
        if self.marker is None or not self.marker < self.square:
            raise ValueError(f"marker: {self.marker}, expected the side of a marker, less than that of a square ({self.square})")
        if min(columns, rows) < 3:
            raise ValueError(f"squares: {columns}x{rows} of a ChArUco board, expected at least 3x3")
        code = getattr(cv2.aruco, self.dictionary, None) if self.dictionary.startswith("DICT_") else None
        if code is None:
            raise ValueError(f"dictionary: '{self.dictionary}', expected a name of OpenCV's such as DICT_4X4_100")
        count, last = len(cv2.aruco.getPredefinedDictionary(code).bytesList), self.first_id + columns * rows // 2 - 1
        if last >= count:
            raise ValueError(f"first_id: markers {self.first_id} to {last} are needed, expected at most {count - 1} in {self.dictionary}")
        return self

    @property
    def grid(self) -> tuple[int, int]:
        """Columns and rows of its corners (or circles)."""
        inner = 0 if self.kind == "circles" else 1
        return self.squares[0] - inner, self.squares[1] - inner

    def __str__(self) -> str:
        name = {"charuco": "ChArUco", "chessboard": "chessboard", "circles": "circles"}[self.kind]
        return f"{name} {self.squares[0]}x{self.squares[1]}" + (f" from marker {self.first_id}" if self.kind == "charuco" else "")


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid")

    board: Annotated[tuple[Board, ...], Field(min_length=1)]

    @model_validator(mode="before")
    @classmethod
    def _one_or_several(cls, content: object) -> object:
        return content if not isinstance(content, dict) or "board" in content else {"board": [content]}

    @model_validator(mode="after")
    def _apart(self) -> _File:
        used: set[tuple[str, int]] = set()
        for board in self.board:
            if board.kind == "charuco":
                ids = {(board.dictionary, board.first_id + i) for i in range(board.squares[0] * board.squares[1] // 2)}
                if ids & used:
                    raise ValueError(f"first_id: marker {min(ids & used)[1]} is on two boards, expected each on one")
                used |= ids
        plain = [board for board in self.board if board.kind != "charuco"]
        if len({(board.kind, frozenset(board.squares), board.inverted) for board in plain}) < len(plain):
            raise ValueError("two boards without markers look the same, expected boards that pictures tell apart")
        return self


def read_boards(path: Path) -> tuple[Board, ...]:
    """Read ``board.toml``. Raises InputError: unreadable, an unknown key, or a board that cannot be, in one sentence."""
    try:
        return read_toml(path, _File).board
    except InputError as error:
        raise InputError(str(error).replace(f"{path}: board.0.", f"{path}: ", 1).replace(f"{path}: board.0: ", f"{path}: ", 1)) from error


@functools.lru_cache(maxsize=64)
def corner_points(board: Board) -> np.ndarray:
    """(N, 3) metres, z = 0: the corner with id i in row i; x along a row of squares, y from row to row, z into the board (OpenCV's axes).

    The origin is the first corner of a chessboard, the first circle of a grid, and of a ChArUco board the outer corner of its first square.
    Do not write to it: it is shared.
    """
    columns, rows = board.grid
    row, column = np.divmod(np.arange(columns * rows), columns)
    x = 2 * column + row % 2 if board.asymmetric else column
    start = 1 if board.kind == "charuco" else 0
    points = board.square * np.stack([x + start, row + start, np.zeros(len(row))], -1)
    points.setflags(write=False)
    return points


@functools.lru_cache(maxsize=64)
def marker_points(board: Board, legacy: bool = False) -> dict[int, np.ndarray]:
    """(4, 3) metres: the corners of every marker of a ChArUco board, from its upper left one clockwise, by id.

    Args:
        legacy: as OpenCV before 4.6 drew boards with an even number of rows, beginning with a white square.
    """
    ids = np.arange(board.first_id, board.first_id + board.squares[0] * board.squares[1] // 2)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    drawn = cv2.aruco.CharucoBoard(board.squares, board.square, board.marker or 0.0, dictionary, ids)
    drawn.setLegacyPattern(legacy)
    return {int(i): np.reshape(corners, (4, 3)).astype(np.float64) for i, corners in zip(drawn.getIds(), drawn.getObjPoints(), strict=True)}


@functools.lru_cache(maxsize=64)
def turns(board: Board) -> tuple[np.ndarray, np.ndarray]:
    """The quarter turns of a board that bring its corners onto its corners.

    Returns:
        (K, N) ids: ``turns[k][i]`` is where corner i comes to lie, the identity first; and (K,) bool: whether the board then looks the
        same, so that no picture tells which end is which. Of the others black and white change places.
    """
    points = corner_points(board)[:, :2]
    places = points - points.mean(0)
    found, same = [], []
    for turn in range(4 if board.kind != "charuco" else 1):
        x, y = np.array([1.0, 0.0, -1.0, 0.0])[turn], np.array([0.0, 1.0, 0.0, -1.0])[turn]
        turned = places @ np.array([[x, y], [-y, x]])
        distance = np.linalg.norm(turned[:, None] - places[None], axis=2)
        onto = distance.argmin(1)
        if distance.min(1).max() > 1e-3 * board.square:
            continue
        sign = (-1.0) ** np.rint(points.sum(1) / board.square)  # of the saddle at a corner, which a quarter turn changes
        found.append(onto)
        same.append(board.kind != "chessboard" or bool(sign[0] == (-1) ** turn * sign[onto[0]]))
    return np.array(found), np.array(same)

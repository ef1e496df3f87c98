"""An episode as a film: scenes kept while it is flown, drawn and packed as GIF or MP4 afterwards."""

from __future__ import annotations

import importlib.util
import io
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray
from PIL import Image

from imagine.core.errors import InputError
from imagine.sim.exploration import Exploration
from imagine.sim.render import draw_scene
from imagine.sim.scene import Scene, Trails, take_scene

SUFFIXES = (".gif", ".mp4")
DURATION_S = 15.0
"""What a film lasts, the rest on its last picture left out; short episodes last less, so that they do not crawl."""
MOST_FRAMES = 200
_LONGEST_FRAME_S = 0.2
_REST_S = 2.0  # on the last picture, so that one can look at it
_COLOURS = 128  # of a GIF's palette: the drawing's own and the shades at its edges
_PALETTE_FRAMES = 6
_MP4_QUALITY = 20  # libx264's constant rate factor: 18 is hardly to be told from the original, 23 its default

Frame = NDArray[np.uint8]
"""A picture, `[height, width, 3]`."""


@dataclass(frozen=True)
class _KeptScene:
    """A scene with its grids packed: of a large level, hundreds of them as they are would not fit into memory."""

    scene: Scene
    shape: tuple[int, ...]
    packed: bytes

    @classmethod
    def of(cls, scene: Scene) -> _KeptScene:
        grids = np.stack((scene.seen.astype(np.int8), scene.belief))
        nothing = np.empty((0, 0), np.int8)
        rest = replace(scene, seen=nothing.astype(np.bool_), belief=nothing)
        return cls(rest, grids.shape, zstandard.compress(grids.tobytes(), 1))

    def scene_again(self) -> Scene:
        seen, belief = np.frombuffer(zstandard.decompress(self.packed), np.int8).reshape(self.shape)
        return replace(self.scene, seen=seen.astype(np.bool_), belief=belief)


def check_film(path: Path) -> None:
    """Raise InputError, with what to do, where no film of that name can be made: a bad suffix, or MP4 without PyAV."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"--film {path}: films are GIF or MP4: name a file that ends in .gif or .mp4")
    if path.suffix.lower() == ".mp4" and importlib.util.find_spec("av") is None:
        raise InputError(
            f"--film {path}: MP4 needs PyAV, which is not installed: "
            "pip install 'imagine-swarm[film]', or name a file that ends in .gif"
        )


class Film:
    """Keeps scenes of one world evenly over an episode of any length, MOST_FRAMES at most."""

    def __init__(self, size_px: int = 960, scans: bool = False) -> None:
        """Prepare an empty film whose map is at most `size_px` wide and high; `scans` shows what the LiDARs see."""
        self.size_px, self.scans = size_px, scans
        self._kept: list[_KeptScene] = []
        self._last: Scene | None = None
        self._taken = 0
        self._stride = 1
        self._trails = Trails()

    def take(self, exploration: Exploration, world: int = 0) -> None:
        """Take a world as it is now: call it after `reset` and after every step of one episode."""
        self._last = take_scene(exploration, world, self._trails.add(exploration, world), self.scans)
        if self._taken % self._stride == 0:
            self._kept.append(_KeptScene.of(self._last))
        self._taken += 1
        if len(self._kept) > MOST_FRAMES:
            # the film turns out longer than it seemed: every second scene will do, of those kept and those to come
            self._kept = self._kept[::2]
            self._stride *= 2

    def __len__(self) -> int:
        """How many pictures the film has."""
        return len(self._kept) + self._ends_between

    @property
    def _ends_between(self) -> bool:
        """Whether the last scene is not among those kept: a film ends with it all the same."""
        return self._last is not None and self._last.tick != self._kept[-1].scene.tick

    @property
    def scenes(self) -> Iterator[Scene]:
        """The scenes to draw: at even distances, and the last one taken."""
        for kept in self._kept:
            yield kept.scene_again()
        if self._last is not None and self._ends_between:
            yield self._last

    @property
    def frame_s(self) -> float:
        """How long each picture but the last is shown, in seconds; in hundredths, as a GIF counts."""
        return round(min(_LONGEST_FRAME_S, DURATION_S / max(1, len(self) - 1)), 2)

    def frames(self) -> Iterator[Frame]:
        """Draw the film, picture by picture."""
        return (draw_scene(scene, self.size_px) for scene in self.scenes)

    def encode(self, suffix: str) -> bytes:
        """Return the film as the bytes of a `.gif` or `.mp4` file.

        Raises InputError for another suffix, where nothing was taken, and for MP4 without PyAV.
        """
        check_film(Path(f"film{suffix}"))
        if self._last is None:
            raise InputError("the film is empty: take an episode first")
        if suffix.lower() == ".mp4":
            return encode_mp4(self.frames(), self.frame_s, _REST_S)
        return encode_gif(list(self.frames()), self.frame_s, _REST_S)


def encode_gif(frames: Sequence[Frame], frame_s: float, rest_s: float) -> bytes:
    """Return frames of one size as an endless GIF with one palette; each shows for `frame_s`, the last for `rest_s`.

    Equal neighbours become one picture that is shown longer.
    """
    palette = _palette(frames)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [round(1000 * frame_s)] * (len(images) - 1) + [round(1000 * rest_s)]
    file = io.BytesIO()
    images[0].save(file, "GIF", save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=True)
    return file.getvalue()


def _palette(frames: Sequence[Frame]) -> Image.Image:
    """Return an image whose palette suits the whole film: that of some of its frames side by side."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, _PALETTE_FRAMES).round().astype(int))
    strip = np.concatenate([frames[index] for index in chosen], axis=1)
    return Image.fromarray(strip).quantize(_COLOURS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)


def encode_mp4(frames: Iterator[Frame], frame_s: float, rest_s: float) -> bytes:
    """Return frames of one size as H.264 in MP4, for players of any kind; each shows for `frame_s`, the last `rest_s`.

    Odd sides lose their last row or column, which H.264's half-size colour planes cannot hold. Raises InputError
    without PyAV.
    """
    check_film(Path("film.mp4"))
    import av

    file = io.BytesIO()
    first = next(frames)
    height, width = first.shape[0] // 2 * 2, first.shape[1] // 2 * 2
    rate = Fraction(1) / Fraction(frame_s).limit_denominator(100)
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": str(_MP4_QUALITY), "preset": "medium"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.thread_count = 1
        last = first
        for last in itertools.chain([first], frames):
            container.mux(stream.encode(_video_frame(last, height, width)))
        for _ in range(round(rest_s / frame_s) - 1):
            container.mux(stream.encode(_video_frame(last, height, width)))
        container.mux(stream.encode(None))
    return file.getvalue()


def _video_frame(frame: Frame, height: int, width: int) -> Any:
    from av import VideoFrame

    return VideoFrame.from_ndarray(np.ascontiguousarray(frame[:height, :width]), format="rgb24")

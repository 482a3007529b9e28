"""Combine frames: video, numbered pictures, film strip, grid."""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from types import ModuleType

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from msk_ray.errors import ConfigError, StorageFailure

_GAP = 4
_COLOURS = 96
"""Of a GIF."""
_INK, _PAPER = (20, 20, 20), (255, 255, 255)


def write_video(frames: Iterable[np.ndarray], path: Path, fps: float) -> int:
    """Encode frames (h, w, 3), uint8, as H.264 that browsers play, or as a GIF that repeats itself; h and w even.

    Returns:
        How many frames.

    Raises:
        StorageFailure: the file cannot be written.
        ConfigError: the package that encodes films is not installed.
    """
    if path.suffix == ".gif":
        return _write_gif(frames, path, fps)
    av = _encoder(path)
    count = 0
    stream = None
    try:
        # Put the index at the front of the file, so that it plays while it loads.
        with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
            for frame in frames:
                count += 1
                if stream is None:
                    stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
                    stream.height, stream.width = frame.shape[:2]
                    stream.pix_fmt = "yuv420p"
                    stream.options = {"crf": "20"}
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            if stream is not None:
                container.mux(stream.encode())
    except OSError as error:
        raise StorageFailure(f"cannot write {path}: {error.strerror or error}") from error
    return count


def _write_gif(frames: Iterable[np.ndarray], path: Path, fps: float) -> int:
    shots = list(frames)
    if not shots:
        return 0
    # One palette, made from some of the frames, and no dither: what does not change then takes no space.
    some = np.concatenate(shots[:: max(1, len(shots) // 8)])
    palette = Image.fromarray(some).quantize(_COLOURS)
    first, *others = [Image.fromarray(shot).quantize(palette=palette, dither=Image.Dither.NONE) for shot in shots]
    duration = 10 * max(2, round(100 / fps))  # a GIF counts in 10 ms
    try:
        first.save(path, save_all=True, append_images=others, duration=duration, loop=0, optimize=True)
    except OSError as error:
        raise StorageFailure(f"cannot write {path}: {error.strerror or error}") from error
    return len(shots)


def check_video_path(path: Path) -> None:
    """Refuse a film that cannot be written, before anything is computed.

    Raises:
        ConfigError: the message names the suffixes that work, or the package to install.
    """
    if path.suffix not in (".mp4", ".mkv", ".mov", ".gif"):
        raise ConfigError(f"--video {path}: write a name that ends in .mp4, .mkv, .mov or .gif")
    if path.suffix != ".gif":
        _encoder(path)


def _encoder(path: Path) -> ModuleType:
    """The package that encodes films; pictures and film strips do not need it."""
    try:
        import av
    except ImportError as error:
        raise ConfigError(
            f"--video {path}: films need the package av ({error}): pip install av, or write a .gif"
        ) from None
    module: ModuleType = av
    return module


def check_image_path(path: Path) -> None:
    """Refuse a file name without a picture's suffix, before anything is computed.

    Raises:
        ConfigError: the message names the suffixes that work.
    """
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg", ".webp"):
        raise ConfigError(f"--strip {path}: write a name that ends in .png, .jpg or .webp")


def write_frames(frames: Iterable[np.ndarray], folder: Path) -> int:
    """Write frames as frame_000000.png and so on.

    Returns:
        How many.
    """
    count = 0
    for count, frame in enumerate(frames, start=1):
        save_image(Image.fromarray(frame), folder / f"frame_{count - 1:06d}.png")
    return count


def save_image(image: Image.Image, path: Path) -> None:
    """Write a picture and create its folder.

    Raises:
        StorageFailure: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        image.save(path)
    except OSError as error:
        raise StorageFailure(f"cannot write {path}: {error.strerror or error}") from error


def strip(frames: Sequence[np.ndarray], captions: Sequence[str]) -> Image.Image:
    """Frames of equal size side by side, each with a caption below."""
    return grid([frames], [""], [captions])


def grid(rows: Sequence[Sequence[np.ndarray]], titles: Sequence[str], captions: Sequence[Sequence[str]]) -> Image.Image:
    """Rows of frames of equal size, each frame with a caption below and each row with a title above.

    A row may be shorter than the others; an empty title takes no space.
    """
    height, width = rows[0][0].shape[:2]
    size = max(11, height // 14)
    font = ImageFont.load_default(size=size)
    line = int(1.5 * size)
    tops = []
    y = 0
    for title in titles:
        tops.append(y)
        y += (line if title else 0) + height + line + _GAP
    columns = max(len(row) for row in rows)
    image = Image.new("RGB", (columns * (width + _GAP) - _GAP, y - _GAP), _PAPER)
    draw = ImageDraw.Draw(image)
    for row, title, texts, row_top in zip(rows, titles, captions, tops, strict=True):
        top = row_top
        if title:
            draw.text((0, top), title, _INK, font)
            top += line
        for column, (frame, text) in enumerate(zip(row, texts, strict=True)):
            left = column * (width + _GAP)
            image.paste(Image.fromarray(frame), (left, top))
            draw.text((left + 2, top + height), text, _INK, font)
    return image

"""Frames into one GIF or MP4, written completely or not at all."""

import io
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.tools.files import write_bytes
from arcade_torch.tools.optional import need
from arcade_torch.tools.play.session import Frame

FASTEST_FPS = {".gif": 50, ".mp4": 240}  # a GIF shows a frame for 2 hundredths of a second or more
# Quality of x264: 0 is lossless, 23 its default. Most players want this pixel format.
_ENCODING = ("-c:v", "libx264", "-crf", "14", "-pix_fmt", "yuv420p", "-movflags", "+faststart")
_PALETTE_SIZE = 256


def writer_for(path: Path) -> Callable[[Path, Iterable[Frame], float], Path]:
    """The writer that a file's name asks for."""
    if path.suffix not in FASTEST_FPS:
        raise ValueError(f"the file must end in .gif or .mp4, got {path}")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: choose a file")
    need("PIL" if path.suffix == ".gif" else "imageio_ffmpeg")
    return write_gif if path.suffix == ".gif" else write_mp4


def write_gif(path: Path, frames: Iterable[Frame], fps: float) -> Path:
    """Write an endless GIF. Frames of up to 256 colours, as the games' are, keep every pixel."""
    need("PIL.Image")
    pictures = _pictures(frames)
    buffer = io.BytesIO()
    duration_ms = 10 * max(1, round(100 / fps))
    next(pictures).save(buffer, "GIF", save_all=True, append_images=pictures, duration=duration_ms, loop=0)
    return write_bytes(path, buffer.getvalue())


def _pictures(frames: Iterable[Frame]) -> Iterator[Any]:
    """Frames as Pillow images, by palette where the colours fit into one."""
    image = need("PIL.Image")
    for frame in frames:
        packed = frame.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
        colours, index = np.unique(packed, return_inverse=True)
        if len(colours) > _PALETTE_SIZE:
            yield image.fromarray(frame).quantize(_PALETTE_SIZE)
            continue
        picture = image.fromarray(index.reshape(packed.shape).astype(np.uint8))
        picture.putpalette(np.stack([colours >> 16, colours >> 8 & 255, colours & 255], -1).astype(np.uint8).tobytes())
        yield picture


def write_mp4(path: Path, frames: Iterable[Frame], fps: float) -> Path:
    """Write an H.264 film that browsers show; colours are subsampled, pixels are not exact."""
    program = need("imageio_ffmpeg").get_ffmpeg_exe()
    rest = iter(frames)
    first = next(rest)
    size = f"{first.shape[1]}x{first.shape[0]}"
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(fps), "-i", "-"]
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.mp4"
        words = [program, "-v", "error", *source, *_ENCODING, str(film)]
        with subprocess.Popen(words, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            assert process.stdin is not None and process.stderr is not None
            with suppress(BrokenPipeError):  # ffmpeg has given up; it says why below
                for frame in chain([first], rest):
                    process.stdin.write(np.ascontiguousarray(frame).data)
                process.stdin.close()
            complaint = process.stderr.read().decode(errors="replace")
        if process.returncode:
            raise ValueError(f"ffmpeg could not write {path}: {complaint.strip() or process.returncode}")
        return write_bytes(path, film.read_bytes())

"""Frames to MP4 and GIF by the ffmpeg that the optional extra `animation` brings.

A film gets its name once it is whole. Until then it has a hidden one, and an interruption removes it and ends ffmpeg.
"""

from __future__ import annotations

import contextlib
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import IO, Any, cast

from servobench.harness.config.installation import missing_extra
from servobench.harness.config.settings import ConfigurationError
from servobench.plant.rendered.detection import ByteArray

MP4, GIF = "mp4", "gif"
GIF_WIDTH, GIF_RATE = 640, 10  # px, frames a second
QUALITY = "22"  # of H.264: smaller is better and larger

Write = Callable[[ByteArray], None]
"""Appends a frame (height, width, 3) to a film."""


def find_ffmpeg(alternative: str) -> str:
    """Return the path of ffmpeg.

    Args:
        alternative: what the user can do without it, the end of the message.

    Raises:
        ConfigurationError: there is none.
    """
    try:
        package: Any = import_module("imageio_ffmpeg")
        return str(package.get_ffmpeg_exe())
    except ImportError as error:
        raise ConfigurationError(f"{missing_extra(error, 'a film')}; {alternative}") from error
    except RuntimeError as error:
        raise ConfigurationError(f"no ffmpeg for mp4 and gif, {alternative}: {error}") from error


@contextmanager
def encoding(ffmpeg: str, path: Path, size: tuple[int, int], rate: float) -> Iterator[Write]:
    """Yield what appends a frame to the film `path`, which is there when the context ends without an exception.

    Args:
        ffmpeg: the program.
        path: of the film, ending with .mp4 or .gif.
        size: width and height of the frames [px]; even numbers for MP4.
        rate: frames a second.

    Raises:
        ConfigurationError: ffmpeg cannot write the film; with its last line.
    """
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", f"{rate:g}", "-i", "-"]
    call = [ffmpeg, "-y", "-v", "error", *raw, *_options(path.suffix.removeprefix("."), rate), str(partial)]
    with tempfile.TemporaryFile() as complaints:
        process = subprocess.Popen(
            call, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=complaints, start_new_session=True
        )

        pipe = cast("IO[bytes]", process.stdin)

        def write(frame: ByteArray) -> None:
            try:
                pipe.write(frame.tobytes())
            except OSError as error:
                raise _failure(path, process, complaints) from error

        try:
            yield write
            with contextlib.suppress(BrokenPipeError):
                pipe.close()
            if process.wait() != 0:
                raise _failure(path, process, complaints)
            partial.replace(path)
        finally:
            process.kill()  # nothing happens if it has ended
            process.wait()
            with contextlib.suppress(OSError):
                pipe.close()
            partial.unlink(missing_ok=True)


def _options(kind: str, rate: float) -> list[str]:
    if kind == MP4:
        return [
            "-c:v",
            "libx264",
            "-pix_fmt",
            "yuv420p",
            "-crf",
            QUALITY,
            "-preset",
            "medium",
            "-movflags",
            "+faststart",
        ]
    # One palette for the whole film, no dithering, and only the rectangle that changed: a still background is free.
    chain = (
        f"fps={min(float(GIF_RATE), rate):g},scale={GIF_WIDTH}:-1:flags=area,split[a][b];"
        "[a]palettegen=max_colors=128:stats_mode=full[p];[b][p]paletteuse=dither=none:diff_mode=rectangle"
    )
    return ["-filter_complex", chain, "-c:v", "gif"]


def _failure(path: Path, process: subprocess.Popen[bytes], complaints: IO[bytes]) -> ConfigurationError:
    """Return what the user is told when ffmpeg has ended with a complaint."""
    code = process.wait()
    complaints.seek(0)
    lines = complaints.read().decode(errors="replace").split("\n")
    said = next((line.strip() for line in reversed(lines) if line.strip()), f"it ended with exit code {code}")
    return ConfigurationError(f"ffmpeg cannot write {path}: {said}")

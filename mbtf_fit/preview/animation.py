"""The turntable's frames as files: GIF, and MP4 with ffmpeg."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mbtf_core.errors import EngineError, reason
from mbtf_core.files.atomic import write_file, write_through

# Milliseconds of one rotation.
TURN = 2400


def write_gif(path: Path, pictures: Sequence[NDArray[np.uint8]]) -> None:
    """Write an endlessly repeated animation with a common palette, atomically."""
    strip = Image.fromarray(np.concatenate(pictures[:: max(1, len(pictures) // 8)], axis=0))
    palette = strip.quantize(255, method=Image.Quantize.MEDIANCUT)
    coded = [
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures
    ]
    pause = max(20, round(TURN / len(coded)))

    options = {"append_images": coded[1:], "duration": pause, "loop": 0, "optimize": False}
    write_file(path, lambda file: coded[0].save(file, format="GIF", save_all=True, **options))


def find_encoder() -> str:
    """Path of ffmpeg: the installed one, or that of the package ``imageio-ffmpeg``.

    Raises
    ------
    EngineError : there is none
    """
    found = shutil.which("ffmpeg")
    if found is None:
        try:
            import imageio_ffmpeg

            found = str(imageio_ffmpeg.get_ffmpeg_exe())
        except (ImportError, RuntimeError):
            raise EngineError(
                "there is no ffmpeg",
                where="--mp4",
                hint="install it, or run: pip install 'mbtf[video]' (68 MB)",
            ) from None
    return found


def write_mp4(path: Path, pictures: Sequence[NDArray[np.uint8]], encoder: str) -> None:
    """Write one rotation as H.264 in MP4, atomically.

    Raises
    ------
    EngineError : the encoder fails
    """
    rows, columns = pictures[0].shape[:2]
    command = [encoder, "-v", "error", "-y", "-f", "rawvideo", "-pixel_format", "rgb24"]
    command += ["-video_size", f"{columns}x{rows}", "-framerate", f"{1000 * len(pictures)}/{TURN}", "-i", "-"]
    # Browsers need halved chroma, hence even sides, and the index at the front.
    command += ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264", "-crf", "18"]
    command += ["-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4"]

    def encode(file: Path) -> None:
        frames = np.stack(pictures).tobytes()
        done = subprocess.run([*command, str(file)], input=frames, capture_output=True, check=False)
        if done.returncode:
            said = reason(done.stderr.decode(errors="replace").strip())
            raise EngineError(f"ffmpeg failed: {said}", where=path, hint="leave out --mp4")

    write_through(path, encode)

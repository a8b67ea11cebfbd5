"""Videos that play everywhere: H.264 in MP4, 4:2:0, index at the front."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import OutputContainer
from av.video.reformatter import Colorspace
from jaxtyping import UInt8

from tidefield.errors import RunError
from tidefield.files import completed_file
from tidefield.model.rendering import Rendering
from tidefield.render.stills import to_8bit

QUALITY = {"crf": "18", "preset": "medium"}
"""x264's scale ends at 0, lossless; 18 is where the eye stops to see a difference."""
BT709, LIMITED_RANGE = 1, 1
"""ISO/IEC 23091-2 code for BT.709 (matrix, primaries and curve alike), and libavcodec's code for levels 16..235."""


def write_video(
    frames: Iterable[Rendering | UInt8[np.ndarray, "H W 3"]],
    path: Path,
    frames_per_second: float,
    *,
    overwrite: bool = False,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Encode frames as they come; memory does not grow with their number.

    Odd sizes are made even by repeating the last column or row, because 4:2:0 needs that. The file appears under its
    name only when it is complete: an exception or Ctrl-C leaves nothing behind.

    Args:
        frames: renderings (their colour is shown) or 8-bit pictures, all of one size.
        progress: called with the number of frames that are done after each.

    Returns:
        The number of frames.

    Raises:
        RunError: the name is no MP4 or is taken, there are no frames, or the folder cannot be written to.
    """
    if path.suffix.lower() != ".mp4":
        raise RunError(f"a video cannot be written as {path.name}: expected a name that ends in .mp4")
    count = 0
    with (
        completed_file(path, overwrite=overwrite) as partial,
        av.open(str(partial), "w", format="mp4", options={"movflags": "+faststart"}) as container,
    ):
        stream = None
        for frame in frames:
            picture = _even(to_8bit(frame.colour) if isinstance(frame, Rendering) else frame)
            if stream is None:
                stream = _stream(container, picture, frames_per_second)
            assert picture.shape == (stream.height, stream.width, 3), "all frames of a video have one size"
            image = av.VideoFrame.from_ndarray(picture, format="rgb24")
            image = image.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)
            image.colorspace = BT709
            container.mux(stream.encode(image))
            count += 1
            if progress:
                progress(count)
        if stream is None:
            raise RunError(f"{path} would have no frames: expected at least one; ask for more frames")
        container.mux(stream.encode())
    return count


def _even(picture: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "even_H even_W 3"]:
    height, width = picture.shape[:2]
    padded = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    return np.ascontiguousarray(padded)


def _stream(
    container: OutputContainer, picture: UInt8[np.ndarray, "H W 3"], frames_per_second: float
) -> av.VideoStream:
    rate = Fraction(frames_per_second).limit_denominator(1001)
    stream = container.add_stream("libx264", rate=rate, options=QUALITY)
    stream.height, stream.width = picture.shape[:2]
    stream.pix_fmt = "yuv420p"
    # Untagged, players guess the matrix from the size, and colours shift.
    context = stream.codec_context
    context.colorspace = context.color_primaries = context.color_trc = BT709
    context.color_range = LIMITED_RANGE
    return stream

"""Write videos for every player: H.264 in MP4, 4:2:0, index at the front."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import OutputContainer
from av.video.reformatter import Colorspace
from jaxtyping import UInt8

from tidefield import SOFTWARE
from tidefield.errors import RunError
from tidefield.files import completed_file
from tidefield.model.rendering import Rendering
from tidefield.render.stills import colour_picture

QUALITY = {"crf": "18", "preset": "medium"}
"""x264's constant rate factor; 0 is lossless, and at 18 differences become invisible (FFmpeg's H.264 guide)."""
BT709, LIMITED_RANGE = 1, 1
"""ISO/IEC 23091-2's code for BT.709 (matrix, primaries and transfer curve), and libavcodec's for levels 16..235."""


def write_video(
    frames: Iterable[Rendering | UInt8[np.ndarray, "H W 3"]],
    path: Path,
    frames_per_second: float,
    *,
    title: str | None = None,
    overwrite: bool = False,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Encode frames one by one; memory does not grow with their number.

    Odd sizes are made even by repeating the last column or row, because 4:2:0 needs that. The file appears under its
    name only when it is complete: an exception or Ctrl-C leaves nothing behind.

    Args:
        frames: renderings (of which the colour is shown) or 8-bit pictures, all of one size.
        path: of the MP4.
        frames_per_second: of the video.
        title: for the file's metadata, which also name this program.
        overwrite: replace an existing file.
        progress: called after each frame with the number of frames that are done.

    Returns:
        The number of frames.

    Raises:
        RunError: the name is no MP4 or exists, there are no frames, or the folder cannot be written to.
    """
    if path.suffix.lower() != ".mp4":
        raise RunError(f"a video cannot be written as {path.name}: expected a name that ends in .mp4")
    count, stream = 0, None
    with (
        completed_file(path, overwrite=overwrite) as partial,
        # FFmpeg takes what is before a colon for a protocol, unless a slash is before it.
        av.open(str(partial.absolute()), "w", format="mp4", options={"movflags": "+faststart"}) as container,
    ):
        container.metadata.update({"comment": SOFTWARE, **({"title": title} if title else {})})
        for count, frame in enumerate(frames, start=1):
            picture = colour_picture(frame) if isinstance(frame, Rendering) else frame
            height, width = picture.shape[:2]
            picture = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            if stream is None:
                stream = _stream(container, picture, frames_per_second)
            assert picture.shape == (stream.height, stream.width, 3), "all frames of a video have one size"
            image = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            image = image.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)
            image.colorspace = BT709
            container.mux(stream.encode(image))
            if progress:
                progress(count)
        if stream is None:
            raise RunError(f"{path} would have no frames: expected at least one; ask for more frames")
        container.mux(stream.encode())
    return count


def _stream(
    container: OutputContainer, picture: UInt8[np.ndarray, "H W 3"], frames_per_second: float
) -> av.VideoStream:
    """Add an H.264 stream of a picture's size to a container."""
    rate = Fraction(frames_per_second).limit_denominator(1001)
    stream = container.add_stream("libx264", rate=rate, options=QUALITY)
    stream.height, stream.width = picture.shape[:2]
    stream.pix_fmt = "yuv420p"
    # Without tags players guess the matrix from the size, and colours shift.
    context = stream.codec_context
    context.colorspace = context.color_primaries = context.color_trc = BT709
    context.color_range = LIMITED_RANGE
    return stream

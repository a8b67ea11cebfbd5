"""Write views of two dates: side by side, as a page that swipes, as a video that fades, and their differences."""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from tidefield import SOFTWARE
from tidefield.change.kinds import COLOUR, GAINED, HIGHER, LIGHT, LOST, LOWER, UNKNOWN, View
from tidefield.files import completed_file, write_text
from tidefield.maps.styles import GAINED as GREEN
from tidefield.maps.styles import HIGHER as BLUE
from tidefield.maps.styles import LOST as BROWN
from tidefield.maps.styles import LOWER as RED
from tidefield.pages import template_environment

KINDS = {
    LOWER: ("lower", RED, 0.6),
    HIGHER: ("higher", BLUE, 0.6),
    GAINED: ("plants gained", GREEN, 0.6),
    LOST: ("plants lost", BROWN, 0.6),
    COLOUR: ("another colour, same height", "#8a3ea8", 0.5),
    LIGHT: ("light only (or wetness)", "#e8c12a", 0.4),
}
"""Name, colour and opacity of what is shown of each kind."""
FRAMES_PER_SECOND = 24.0
_HOLD, _FADE = 24, 48
"""Frames that a date is shown, and that the other takes to appear."""
_BAND_PX = 30
"""Height of the strip with names above pictures."""
_PAPER, _INK = (255, 255, 255), (28, 35, 40)


def write_views(view: View, names: tuple[str, str], folder: Path) -> list[Path]:
    """Write earlier.png, later.png, side_by_side.png, difference.png, swipe.html and fade.mp4.

    Args:
        names: of both dates, for people.
        folder: an existing one.
    """
    from tidefield.render.video import write_video

    pictures = {
        "earlier.png": view.earlier,
        "later.png": view.later,
        "side_by_side.png": side_by_side(view, names),
        "difference.png": difference(view),
    }
    for name, picture in pictures.items():
        with completed_file(folder / name) as partial:
            Image.fromarray(picture).save(partial, format="PNG")
    write_text(folder / "swipe.html", swipe_page(view, names))
    title = f"{view.name}: {names[0]} to {names[1]}"
    write_video(_fading(view), folder / "fade.mp4", FRAMES_PER_SECOND, title=title)
    return [folder / name for name in (*pictures, "swipe.html", "fade.mp4")]


def side_by_side(view: View, names: tuple[str, str]) -> UInt8[np.ndarray, "h w 3"]:
    """Both dates beside each other, with their names above."""
    gap = np.full((view.earlier.shape[0], 8, 3), 255, np.uint8)
    both = np.concatenate([view.earlier, gap, view.later], axis=1)
    at = ((6, names[0], _INK), (view.earlier.shape[1] + 14, names[1], _INK))
    return np.concatenate([_strip(both.shape[1], at), both])


def difference(view: View) -> UInt8[np.ndarray, "h w 3"]:
    """The later view in grey with what differs in colours, their names and shares above; dark is not compared."""
    grey = np.repeat((0.35 * 255 + 0.6 * view.later.mean(axis=2, keepdims=True)), 3, axis=2)
    entries, x = [], 6
    for kind, (name, colour, alpha) in KINDS.items():
        rgb = tuple(int(colour[k : k + 2], 16) for k in (1, 3, 5))
        where = view.kinds == kind
        grey[where] = (1 - alpha) * grey[where] + alpha * np.array(rgb)
        share = view.share(kind)
        if share < 0.0005:
            continue
        text = f"{name} {100 * share:.1f}%"
        entries.append((x, text, rgb))
        x += 34 + round(_font().getlength(text))
    grey[view.kinds == UNKNOWN] *= 0.45
    shown = grey.clip(0, 255).astype(np.uint8)
    width = max(shown.shape[1], x)
    wide = np.pad(shown, ((0, 0), (0, width - shown.shape[1]), (0, 0)), constant_values=255)
    return np.concatenate([_strip(width, entries or [(6, "no difference stands out", _INK)]), wide])


def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(16)


def _strip(width: int, entries: object) -> UInt8[np.ndarray, "h w 3"]:
    """A white strip with texts: where they begin, what they say, and the colour of the patch before them."""
    image = Image.new("RGB", (width, _BAND_PX), _PAPER)
    draw = ImageDraw.Draw(image)
    for x, text, colour in entries:  # type: ignore[attr-defined]
        if colour != _INK:
            draw.rectangle((x, 9, x + 12, 21), fill=colour)
            x += 18
        draw.text((x, _BAND_PX // 2), text, fill=_INK, font=_font(), anchor="lm")
    return np.asarray(image)


def _fading(view: View) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Earlier, a fade to later, and back: played in a loop nothing jumps."""
    ramp = (1 - np.cos(np.linspace(0, np.pi, _FADE))) / 2
    weights = np.concatenate([np.zeros(_HOLD), ramp, np.ones(_HOLD), ramp[::-1]])
    for weight in weights:
        mixed = (1 - weight) * view.earlier.astype(np.float32) + weight * view.later
        yield np.round(mixed).astype(np.uint8)


def swipe_page(view: View, names: tuple[str, str]) -> str:
    """A page of both pictures with a handle between them, which needs no other file."""
    environment = template_environment("tidefield.change")
    script = (
        "const of=n=>document.getElementById(n),h=of('handle'),l=of('later'),r=of('rule');"
        'const f=()=>{l.style.clipPath="inset(0 0 0 "+h.value+"%)";r.style.left=h.value+"%"};'
        'h.addEventListener("input",f);f();'
    )
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return environment.get_template("swipe.html").render(
        title=f"{view.name}: {names[0]} and {names[1]}",
        names=names,
        earlier=jpeg(view.earlier),
        later=jpeg(view.later),
        script=script,
        digest=digest,
        software=SOFTWARE,
        width=view.earlier.shape[1],
        height=view.earlier.shape[0],
    )


def jpeg(picture: UInt8[np.ndarray, "h w 3"]) -> str:
    """A picture as a data URL."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="JPEG", quality=90)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")

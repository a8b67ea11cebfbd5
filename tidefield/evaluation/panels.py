"""Draw labelled panels side by side, with colour maps and their scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

WIDEST_PANEL_PX = 800
STRIP_PX = 26  # height of the label above each panel, and of the scale below it
GAP_PX = 4
INK, PAPER = (30, 30, 30), (255, 255, 255)
COLOUR_MAPS = {"viridis": cv2.COLORMAP_VIRIDIS, "magma": cv2.COLORMAP_MAGMA}
"""Perceptually uniform: equal steps of a value look equally large."""


@dataclass(frozen=True)
class Scale:
    """Meaning of a panel's colours: one of `COLOUR_MAPS`, and the values at its ends."""

    colour_map: str
    low: float
    high: float


@dataclass(frozen=True)
class Panel:
    """One labelled picture of a row, with a bar below it if a scale is given."""

    label: str
    image: UInt8[Tensor, "H W 3"]
    scale: Scale | None = None


def colours(values: Float[Tensor, "H W"], scale: Scale) -> UInt8[Tensor, "H W 3"]:
    """Return values as colours of a scale's map, clipped to its ends."""
    # The floor on the range gives a constant image the map's first colour.
    share = (values.cpu() - scale.low) / max(scale.high - scale.low, 1e-12)
    grey = (share.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    return torch.from_numpy(cv2.applyColorMap(grey, COLOUR_MAPS[scale.colour_map])[..., ::-1].copy())


def depth_panel(label: str, depth: Float[Tensor, "H W"]) -> Panel:
    """Return depths as a panel, coloured from their 1st to their 99th percentile."""
    low, high = np.percentile(depth.cpu().numpy(), [1, 99]).tolist()
    scale = Scale("viridis", low, high)
    return Panel(label, colours(depth, scale), scale)


def side_by_side(panels: Sequence[Panel]) -> Image.Image:
    """Draw panels in a row, each below its label, at the height of the first, which is shrunk if it is wide."""
    images = [Image.fromarray(panel.image.cpu().numpy()) for panel in panels]
    height = round(images[0].height * min(1, WIDEST_PANEL_PX / images[0].width))
    images = [image.resize((round(image.width * height / image.height), height)) for image in images]
    strips = 2 if any(panel.scale for panel in panels) else 1
    width = sum(image.width for image in images) + GAP_PX * (len(images) - 1)
    sheet = Image.new("RGB", (width, height + strips * STRIP_PX), PAPER)
    x = 0
    for panel, image in zip(panels, images, strict=True):
        sheet.paste(strip(image.width, panel.label), (x, 0))
        sheet.paste(image, (x, STRIP_PX))
        if panel.scale:
            sheet.paste(_scale_bar(image.width, panel.scale), (x, STRIP_PX + height))
        x += image.width + GAP_PX
    return sheet


def strip(width: int, left: str, right: str = "") -> Image.Image:
    """Draw a strip of paper with text at its ends."""
    band = Image.new("RGB", (width, STRIP_PX), PAPER)
    draw = ImageDraw.Draw(band)
    font = ImageFont.load_default(14)
    draw.text((6, STRIP_PX // 2), left, INK, font, anchor="lm")
    draw.text((width - 6, STRIP_PX // 2), right, INK, font, anchor="rm")
    return band


def _scale_bar(width: int, scale: Scale) -> Image.Image:
    """Draw the colour map between its two values."""
    low, high = (f"{value:.3g}" for value in (scale.low, scale.high))
    band = strip(width, low, high)
    text = max(int(ImageFont.load_default(14).getlength(word)) for word in (low, high)) + 14
    length = width - 2 * text
    if length > 0:
        ramp = torch.linspace(scale.low, scale.high, length).expand(STRIP_PX - 12, -1)
        band.paste(Image.fromarray(colours(ramp, scale).numpy()), (text, 6))
    return band

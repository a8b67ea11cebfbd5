"""Settings of the paper's five categories of tidal flat."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tidefield.errors import SceneError


@dataclass(frozen=True)
class Settings:
    """Parameters of one tidal flat. Lengths in metres; heights above mean mud level."""

    tide_m: float
    """Height of the water in channels and sea."""
    tilt_m: float
    """Fall of the ground from the landward to the seaward edge."""
    relief_m: float
    """Amplitude of the broad humps and hollows."""
    channel_half_width_m: float
    channel_depth_m: float
    channel_spacing_m: float
    """Distance between the mouths of main channels."""
    branch_orders: int
    """Generations of side creeks; 0 for a channel without any."""
    branch_spacing_m: float
    """Mean distance between side creeks along their parent."""
    ripple_m: float
    """Crest height of the sand waves (0.7-1.6 m long); small ripples follow them."""
    pools_per_ha: float
    tufts_per_m2: float
    """Plants per square metre of marsh."""
    marsh_share: float
    """Share of the dry ground that is marsh."""
    trees_per_ha: float
    sand: float
    """0 for grey mud, 1 for ochre sand."""
    algae: float
    """Cover of green-brown algal film."""
    shells: float
    """Density of pale shell and stone litter."""
    wetness: float
    """0 for a flat that has been dry for long, 1 for one that the tide has just left."""
    wave_slope: float
    """Root-mean-square slope of the wavelets on open water."""


_TIDAL_TREES = Settings(
    tide_m=-0.75, tilt_m=0.8, relief_m=0.16, channel_half_width_m=3.2, channel_depth_m=1.25, channel_spacing_m=62.0,
    branch_orders=3, branch_spacing_m=8.5, ripple_m=0.05, pools_per_ha=14.0, tufts_per_m2=2.4, marsh_share=0.12,
    trees_per_ha=40.0, sand=0.2, algae=0.35, shells=0.25, wetness=0.5, wave_slope=0.03,
)  # fmt: skip
CATEGORIES: dict[str, Settings] = {
    "tidal_trees": _TIDAL_TREES,
    "river_mouths": replace(
        _TIDAL_TREES, tide_m=-0.5, tilt_m=1.5, relief_m=0.28, channel_half_width_m=7.0, channel_depth_m=1.5,
        channel_spacing_m=48.0, branch_orders=1, branch_spacing_m=24.0, ripple_m=0.09, pools_per_ha=22.0,
        marsh_share=0.08, trees_per_ha=6.0, sand=0.65, algae=0.15, wetness=0.6, wave_slope=0.05,
    ),
    "ground_textures": replace(
        _TIDAL_TREES, tide_m=-0.55, tilt_m=0.4, relief_m=0.22, channel_half_width_m=1.3, channel_depth_m=0.6,
        channel_spacing_m=70.0, branch_orders=1, branch_spacing_m=16.0, ripple_m=0.12, pools_per_ha=70.0,
        marsh_share=0.03, trees_per_ha=0.0, sand=0.55, algae=0.5, shells=0.8, wetness=0.45, wave_slope=0.02,
    ),
    "vegetation": replace(
        _TIDAL_TREES, tide_m=-0.7, tilt_m=0.6, relief_m=0.25, channel_half_width_m=2.0, channel_depth_m=1.1,
        branch_orders=2, branch_spacing_m=15.0, ripple_m=0.03, pools_per_ha=25.0, tufts_per_m2=3.6, marsh_share=0.55,
        trees_per_ha=60.0, sand=0.1, algae=0.6, shells=0.1, wetness=0.4, wave_slope=0.02,
    ),
    "deep_water": replace(
        _TIDAL_TREES, tide_m=0.1, tilt_m=5.0, relief_m=0.6, channel_half_width_m=4.0, channel_depth_m=0.9,
        channel_spacing_m=75.0, branch_orders=2, branch_spacing_m=14.0, ripple_m=0.08, pools_per_ha=12.0,
        marsh_share=0.12, trees_per_ha=5.0, sand=0.5, algae=0.25, wetness=0.7, wave_slope=0.06,
    ),
}  # fmt: skip
"""Tidal trees are the creeks that branch like trees over a flat; ours carry some mangroves too."""


def settings_for(category: str, random: np.random.Generator) -> Settings:
    """Draw the settings of a category, each varied by up to 15 percent.

    Raises:
        SceneError: the category is unknown.
    """
    if category not in CATEGORIES:
        raise SceneError(f"no synthetic category {category!r}: choose one of {', '.join(CATEGORIES)}")
    settings = CATEGORIES[category]
    varied = {
        name: value * float(random.uniform(0.85, 1.15))
        for name, value in vars(settings).items()
        if isinstance(value, float) and name != "tide_m"
    }
    return replace(settings, **varied)

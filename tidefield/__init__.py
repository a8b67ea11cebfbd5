"""View synthesis of tidal flats from drone photographs.

    import tidefield

    scene = tidefield.load_scene("my-scene", width=400)
    render = tidefield.zero_shot(scene)
    view = render(scene.cameras["DJI_0042.JPG"])

The names below are loaded when they are first used, so that importing the package stays fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"
SOFTWARE = f"tidefield {__version__}"
"""As files name what made them."""
__all__ = ["Cameras", "OpenRun", "Rendering", "Scene", "__version__", "load_scene", "open_run", "zero_shot"]

if TYPE_CHECKING:
    from tidefield.api import OpenRun, open_run, zero_shot
    from tidefield.data.load import load_scene
    from tidefield.data.scene import Scene
    from tidefield.geometry.cameras import Cameras
    from tidefield.model.rendering import Rendering

_MODULES = {
    "Cameras": "geometry.cameras",
    "OpenRun": "api",
    "Rendering": "model.rendering",
    "Scene": "data.scene",
    "load_scene": "data.load",
    "open_run": "api",
    "zero_shot": "api",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return __all__

"""nerfstudio's data parser of every scene that Tidefield reads: `ns-train METHOD --data SCENE tidefield-data`.

nerfstudio's methods expect a scene of about unit size around the origin. The way back into metres and into the scene's
coordinate reference system is kept with the run, in `dataparser_transforms.json`.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from nerfstudio.cameras.cameras import Cameras as NerfstudioCameras
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from PIL import Image

from tidefield.data.cache import cache_folder
from tidefield.data.georeference import find_georeference
from tidefield.data.load import own_lens, read_posed
from tidefield.data.pictures import decode
from tidefield.data.readers.posed import Observations, PosedPhotographs
from tidefield.data.triangulate import triangulate_again
from tidefield.files import completed_file, write_json
from tidefield.geometry.lenses import FisheyeLens, Lens, LensModel

PHOTOGRAPH = "photograph"
"""Entry of nerfstudio's cameras that has the index of the scene's photograph that a camera took."""


@dataclass
class SceneOutputs(DataparserOutputs):
    """What nerfstudio asks a data parser for, and where on the Earth it is.

    Attributes:
        georeference: frame of the scene's coordinates as they are on disk (`LocalFrame.to_json`); None if unknown.
        origin: what was subtracted from these, of which `dataparser_transform` has single precision only.
    """

    georeference: dict[str, Any] | None = None
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def save_dataparser_transform(self, path: Path) -> None:
        """Write `transform` and `scale`, as nerfstudio does, and the `georeference`.

        scale * (transform [p; 1]) takes a point of the scene into nerfstudio's coordinates.
        """
        super().save_dataparser_transform(path)
        values = json.loads(path.read_text(encoding="utf-8"))
        transform = np.column_stack([np.eye(3), -np.array(self.origin)]).tolist()
        write_json(path, {**values, "transform": transform, "georeference": self.georeference})


@dataclass
class SceneParserConfig(DataParserConfig):
    """Scenes of `tidefield prepare` and `import`, and all that Tidefield reads."""

    _target: type = field(default_factory=lambda: SceneParser)
    auto_scale_poses: bool = True
    """Scale positions to at most 1, as nerfstudio's own parser does; otherwise they are in metres around the middle of
    the cameras."""
    load_3D_points: bool = True
    """Read the sparse points, with which splatfacto starts; their colours are read from the photographs."""


class SceneParser(DataParser):
    """Reads poses, lenses, masks, the split and the sparse points of a scene; photographs are left where they are.

    Points are placed and coloured by the training photographs alone, as for our own methods.
    """

    config: SceneParserConfig

    def _generate_dataparser_outputs(self, split: str = "train", **_: Any) -> SceneOutputs:
        root = self.config.data
        posed = read_posed(root, allow_missing=False)
        train, test = posed.train_and_test
        chosen = train if split == "train" else test
        pose, origin = posed.centred
        points = posed.points if split == "train" and self.config.load_3D_points else None
        if points is not None:
            points = replace(points, xyz_world=points.xyz_world - origin)
            if len(points.uv_px):
                points = triangulate_again(points, pose, posed.lenses, train)
                points = replace(points, rgb=_colours(points, posed, train))
        radius = float(np.abs(pose[:, :, 3]).max()) or 1.0
        scale = 1 / radius if self.config.auto_scale_poses else 1.0
        pose[:, :, 3] *= scale
        lenses = [own_lens(posed.paths[i], posed.lenses[i])[0] for i in chosen]
        masks = posed.masks and [posed.masks[i] for i in chosen]
        reach = radius * scale
        georeference = find_georeference(root, posed.reference)
        frame = None if georeference is None else georeference.frame
        metadata: dict[str, Any] = {"root": root}
        if points is not None:
            xyz, rgb = points.xyz_world, points.rgb
            metadata["points3D_xyz"] = torch.from_numpy(xyz * scale).float()
            metadata["points3D_rgb"] = torch.from_numpy(np.full(xyz.shape, 128, np.uint8) if rgb is None else rgb)
        return SceneOutputs(
            image_filenames=[posed.paths[i] for i in chosen],
            cameras=to_nerfstudio(pose[list(chosen)], lenses, chosen),
            alpha_color=torch.tensor(posed.background_rgb or (1.0, 1.0, 1.0)),
            scene_box=SceneBox(aabb=torch.tensor([[-reach] * 3, [reach] * 3])),
            # nerfstudio reads masks of all photographs or of none.
            mask_filenames=[mask or _white(lens) for mask, lens in zip(masks, lenses, strict=True)]
            if masks and any(masks)
            else None,
            metadata=metadata,
            dataparser_transform=torch.from_numpy(np.concatenate([np.eye(3), -origin[:, None]], axis=1)).float(),
            dataparser_scale=scale,
            georeference=None if frame is None else frame.to_json(),
            origin=tuple(origin.tolist()),
        )


def _colours(points: Observations, posed: PosedPhotographs, train: Sequence[int]) -> UInt8[np.ndarray, "P 3"]:
    """Sample each point's colour in the first training photograph that shows it; grey where none does.

    A model's own colours are means over all photographs, the held-out ones included.
    """
    rgb = np.full((len(points.xyz_world), 3), 128, dtype=np.uint8)
    rows = points.by_photograph(len(posed.names))
    for index in reversed(train):
        photograph, lens = decode(posed.paths[index])[..., :3], posed.lenses[index]
        height, width = photograph.shape[:2]
        u, v = np.floor(points.uv_px[rows[index]] * (width / lens.width, height / lens.height)).T
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        at = v[inside].astype(int), u[inside].astype(int)
        rgb[points.point_index[rows[index]][inside]] = photograph[at]
    return rgb


def _white(lens: LensModel) -> Path:
    """A mask of nothing, of a photograph's size."""
    folder = cache_folder() or Path(tempfile.gettempdir())
    path = folder / f"white_{lens.width}x{lens.height}.png"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with completed_file(path, overwrite=True) as partial:
            Image.new("L", (lens.width, lens.height), 255).save(partial, "PNG")
    return path


def to_nerfstudio(
    T_world_camera: Float64[np.ndarray, "V 3 4"], lenses: Sequence[LensModel], photographs: Sequence[int]
) -> NerfstudioCameras:
    """Return cameras as nerfstudio has them.

    Args:
        T_world_camera: poses with OpenCV's axes, in nerfstudio's coordinates.
        lenses: of each camera.
        photographs: the scene's photographs that they took.
    """
    fisheye = [isinstance(lens, FisheyeLens) for lens in lenses]
    distortion = [
        (lens.k1, lens.k2, lens.k3, lens.k4, 0.0, 0.0)
        if isinstance(lens, FisheyeLens)
        else (lens.k1, lens.k2, lens.k3, 0.0, lens.p1, lens.p2)
        for lens in lenses
        if isinstance(lens, Lens | FisheyeLens)
    ]
    calibration = torch.tensor([(lens.fx, lens.fy, lens.cx, lens.cy) for lens in lenses])
    fx, fy, cx, cy = calibration.unbind(1)
    kinds = [CameraType.FISHEYE.value if wide else CameraType.PERSPECTIVE.value for wide in fisheye]
    return NerfstudioCameras(
        camera_to_worlds=torch.from_numpy(T_world_camera * (1, -1, -1, 1)).float(),
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        width=torch.tensor([lens.width for lens in lenses]),
        height=torch.tensor([lens.height for lens in lenses]),
        distortion_params=torch.tensor(distortion),
        camera_type=torch.tensor(kinds),
        metadata={PHOTOGRAPH: torch.tensor(photographs)[:, None]},
    )


PARSER = DataParserSpecification(SceneParserConfig(), "Scenes of Tidefield, with the way back into their coordinates")

"""Everything in Tidefield that reads a file, each with small whole files to damage.

A reader gets a folder that it may change. torch and the rest are imported inside, as in the commands.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.mutations import Mutation, mutate, mutate_value
from tidefield.errors import RunError

_VIEWS, _WIDTH = 4, 48
_SURVEY_VIEWS, _SURVEY_WIDTH = 6, 240
_PLACE = (10.5, 53.6)
"""Longitude and latitude of the survey."""


CPU_SECONDS = 10.0
"""That a reader may compute for a file."""


@dataclass(frozen=True)
class Reader:
    """Something that reads a kind of file.

    Attributes:
        name: shown in the table.
        seed: the folder of whole files, below that of all seeds.
        files: which of them are damaged, as patterns.
        read: reads the folder; what it raises but the project's own errors is a finding.
        damage: makes other bytes of a file's.
        cpu_seconds: that it may compute for a file; more are a finding.
    """

    name: str
    seed: str
    files: tuple[str, ...]
    read: Callable[[Path], object]
    damage: Mutation = mutate
    cpu_seconds: float = CPU_SECONDS


def _scene(folder: Path) -> None:
    from tidefield.data.load import load_scene

    load_scene(folder)


def _description(folder: Path) -> None:
    """A scene without the exposures of its photographs, which take most of the time of reading it."""
    import torch

    with patch(
        "tidefield.data.load.estimate_gains", lambda seen, cameras, *_: (torch.ones(len(cameras), 3), np.zeros((2, 3)))
    ):
        _scene(folder)


def _imported(folder: Path) -> None:
    from tidefield.survey.import_project import import_project

    import_project(folder, folder.with_name("imported"))


def _model(folder: Path) -> None:
    from tidefield.survey.sfm.model_files import read_model

    read_model(folder / "sparse" / "0")


def _georeference(folder: Path) -> None:
    from tidefield.data.georeference import read_georeference

    found = read_georeference(folder)
    if found is not None:
        found.write(folder)


def _survey(folder: Path) -> None:
    from tidefield.survey.io.image_decoding import thumbnail, upright
    from tidefield.survey.io.photographs import read_survey

    control = folder / "gcp_list.txt"
    for photograph in read_survey(folder, control=control if control.exists() else None).photographs:
        upright(photograph)
        thumbnail(photograph, 16)


def _positions(folder: Path) -> None:
    """A table of positions, which has priority over EXIF."""
    from tidefield.survey.io.photographs import read_survey

    read_survey(folder, next(file for file in folder.iterdir() if file.suffix in (".csv", ".txt")))


def _metadata(folder: Path) -> None:
    """EXIF and XMP that are damaged inside a whole JPEG."""
    from PIL import Image

    exif, packet = (folder / "exif.bin").read_bytes()[:65_000], (folder / "packet.xmp").read_bytes()[:65_000]
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        Image.new("RGB", (32, 24)).save(folder / name, exif=exif, xmp=packet)
    _survey(folder)


def _prepared(folder: Path) -> None:
    """A scene that is complete: what is damaged would be done again, which ends the reading here."""
    from rich.console import Console

    from tidefield.commands.prepare import prepare
    from tidefield.survey.stages import Stages

    class Reading(Stages):
        def run(
            self,
            name: str,
            options: Any,
            outputs: Any,
            job: Any,
            read: Any = lambda facts: facts,
            *,
            inputs: Any = None,
        ) -> Any:
            def refuse(_: bool) -> Any:
                raise RunError(f"{name} would be done again")

            return super().run(name, options, outputs, refuse, read, inputs=inputs)

    with patch("tidefield.survey.prepare.Stages", Reading):
        prepare(_prepare_options(folder), Console(file=StringIO()))


def _prepare_options(folder: Path) -> Any:
    from tidefield.commands.prepare import Prepare

    return Prepare(folder / "photographs", folder / "scene", features=1000, feature_width=400, device="cpu")


def _run(folder: Path) -> None:
    from tidefield.api import open_run
    from tidefield.config import Config
    from tidefield.methods import make_trainer
    from tidefield.train.checkpoint import read_run

    with open_run(folder, "cpu") as opened:
        config = opened.config
        assert isinstance(config, Config)
        trainer = make_trainer(config, opened.scene, read_run(folder).seed, opened.scene.cameras.T_world_camera.device)
        trainer.resume(folder)


def _weights(folder: Path) -> None:
    from tidefield.api import zero_shot
    from tidefield.data.load import load_scene

    zero_shot(load_scene(folder / "scene"), weights=folder / "weights.safetensors", device="cpu")


def _comparison(folder: Path) -> None:
    from tidefield.compare.results import read_results
    from tidefield.compare.run import Settings
    from tidefield.compare.tables import write_comparison

    results = read_results(folder, ["flat"], ["tidefield"])
    write_comparison(results, {"flat": folder / "scene"}, Settings(1.0, None, None, "cpu", 0), folder)


def _evaluation(folder: Path) -> None:
    from tidefield.evaluation.evaluate import delete_evaluation

    delete_evaluation(folder / "runs" / "flat" / "tidefield", ["a.jpg"])


def _validation(folder: Path) -> None:
    from tidefield.train.pretrain import Validation

    Validation({}, folder)


def _nerfstudio_job(folder: Path) -> None:
    from tidefield.baselines.nerfstudio.driver import _read_job, progress_of

    progress_of(folder)
    assert _read_job(folder)[1].factor.isfinite().all()


def _opensplat(folder: Path) -> None:
    import torch

    from tidefield.baselines.opensplat import progress_of, renderer
    from tidefield.geometry.cameras import Cameras

    progress_of(folder)
    pose, size = torch.eye(3, 4)[None], torch.tensor([[16, 16]])
    view = renderer(folder, torch.device("cpu"))(
        Cameras(pose, 16.0 * torch.ones(1, 2), size / 2, size, torch.tensor([[1.0, 9.0]]), torch.ones(1, 3))
    )
    assert view.colour.isfinite().all()
    assert view.depth.isfinite().all()


def _demonstration(folder: Path) -> None:
    from tidefield.commands.demo import Made

    Made(folder, ["scene", "view.mp4"]).require_own(overwrite=True)


def _camera_path(folder: Path) -> None:
    from tidefield.data.load import load_scene
    from tidefield.render.camera_paths import make_trajectory

    make_trajectory(str(folder / "path.json"), load_scene(folder), frames=4, width=64, height=48)


def _mutate_tensors(content: bytes, random: Random) -> bytes:
    """Damage what a file of tensors holds, and give it the right SHA-256."""
    from safetensors.torch import load, save

    from tidefield.train.checkpoint import _sha256

    if random.random() < 0.3:
        return mutate(content, random)
    length = int.from_bytes(content[:8], "little")
    header = json.loads(json.loads(content[8 : 8 + length])["__metadata__"]["tidefield"])
    del header["sha256"]
    tensors = load(content)
    if random.random() < 0.7:
        header = mutate_value(header, random)
    else:
        name = random.choice(list(tensors))
        value, kind = tensors.pop(name), random.randrange(5)
        if kind == 0:
            tensors[name] = value.flatten()
        elif kind == 1:
            tensors[name] = (value.double() * random.choice((float("nan"), float("inf"), 1e300))).to(value.dtype)
        elif kind == 2:
            tensors[name] = value.bool()
        elif kind == 3:
            tensors[name + random.choice(("", ".x", "\0"))] = value[:0].contiguous() if value.ndim else value
    if isinstance(header, dict):
        header |= {"sha256": _sha256(tensors, header)}
    return save(tensors, {"tidefield": json.dumps(header)})


_PHOTOGRAPHS = ("images/*.png",)
READERS = (
    Reader(
        "COLMAP, binary", "colmap", ("sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"), _scene
    ),
    Reader("COLMAP, text", "colmap_text", ("sparse/0/*.txt",), _description),
    Reader("COLMAP, for pycolmap", "colmap", ("sparse/0/*.bin",), _model),
    Reader("COLMAP, imported", "colmap", ("sparse/0/*.bin",), _imported),
    Reader("transforms.json", "transforms", ("transforms.json",), _scene),
    Reader("PLY", "transforms", ("sparse_pc.ply",), _scene),
    Reader("Blender", "blender", ("transforms_*.json",), _scene),
    Reader("LLFF", "llff", ("poses_bounds.npy",), _scene),
    Reader("OpenSfM", "opensfm", ("reconstruction.json", "tracks.csv", "reference_lla.json"), _description),
    Reader("OpenSfM, imported", "opensfm", ("reconstruction.json", "tracks.csv", "reference_lla.json"), _imported),
    Reader("ODM", "odm", ("opensfm/reconstruction.json", "opensfm/image_list.txt"), _scene),
    Reader("photographs of a scene", "transforms", _PHOTOGRAPHS, _scene),
    Reader("photographs of a scene, JPEG", "opensfm", ("images/*.jpg",), _scene),
    Reader("photographs of a survey", "survey", ("*.jpg", "*.png", "*.tif"), _survey),
    Reader("EXIF", "metadata", ("exif.bin",), _metadata),
    Reader("XMP", "metadata", ("packet.xmp",), _metadata),
    Reader("gps.csv", "gps", ("gps.csv",), _positions),
    Reader("geo.txt", "geo", ("geo.txt",), _positions),
    Reader("gcp_list.txt", "control", ("gcp_list.txt",), _survey),
    Reader("georeference.json", "prepared/scene", ("georeference.json",), _georeference),
    Reader("stages.json", "prepared", ("scene/prepare/stages.json",), _prepared),
    Reader("models of a prepared scene", "prepared", ("scene/prepare/model/*", "scene/sparse/0/*"), _prepared),
    Reader("database of a prepared scene", "prepared", ("scene/prepare/database.db",), _prepared),
    Reader("run.json", "run", ("run.json",), _run),
    Reader("checkpoint", "run", ("checkpoint.safetensors",), _run, _mutate_tensors),
    Reader("weights", "weights", ("weights.safetensors",), _weights, _mutate_tensors),
    Reader("results of a comparison", "comparison", ("runs/*/*/*.json",), _comparison),
    Reader("renderings of a comparison", "comparison", ("runs/*/*/renderings/*",), _comparison),
    Reader("evaluation.json, replaced", "comparison", ("runs/flat/tidefield/evaluation.json",), _evaluation),
    Reader("validation.json", "small", ("validation.json",), _validation),
    Reader("job.json of nerfstudio", "small", ("job.json",), _nerfstudio_job),
    Reader("job.json and splats of OpenSplat", "small", ("opensplat/job.json", "opensplat/splat.ply"), _opensplat),
    Reader("demonstration.json", "small", ("demonstration.json",), _demonstration),
    Reader("nerfstudio's camera path", "path", ("*.json",), _camera_path),
)


def make_seeds(folder: Path) -> None:
    """Write whole files of every kind, with the built-in generator."""
    from tidefield.data.load import read_posed
    from tidefield.synthetic import make_survey, write_survey

    scene = folder / "colmap"
    write_survey(make_survey("ground_textures", seed=1, views=_VIEWS, width=_WIDTH, supersample=1), scene)
    shutil.rmtree(scene / "truth")
    _make_layouts(folder, scene)
    posed = read_posed(scene, allow_missing=False)
    _make_opensfm(folder, scene, posed)
    _make_survey_files(folder)
    _make_prepared(folder / "prepared")
    _make_runs(folder, scene)
    _make_path(folder, posed)


def _copy(source: Path, target: Path, *leave_out: str) -> Path:
    shutil.copytree(source, target, ignore=shutil.ignore_patterns(*leave_out))
    return target


def _make_layouts(folder: Path, scene: Path) -> None:
    import pycolmap

    from tidefield.survey.export import write_transforms

    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    text = _copy(scene, folder / "colmap_text", "*.bin")
    model.write_text(text / "sparse" / "0")
    transforms = _copy(scene, folder / "transforms", "sparse")
    write_transforms(transforms, model)
    blender = _copy(scene, folder / "blender", "sparse")
    top = json.loads((transforms / "transforms.json").read_text())
    for part in ("train", "test"):
        frames = [
            frame for frame in top["frames"] if (frame["file_path"] in top["train_filenames"]) == (part == "train")
        ]
        angle = 2 * np.arctan(top["w"] / 2 / top["fl_x"])
        (blender / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    llff = _copy(scene, folder / "llff", "sparse")
    matrices = np.array([frame["transform_matrix"][:3] for frame in top["frames"]])
    right, up, back, position = (matrices[:, :, i] for i in range(4))
    size = np.tile([top["h"], top["w"], top["fl_x"]], (len(matrices), 1))
    poses = np.stack([-up, right, back, position, size], axis=2).reshape(-1, 15)
    np.save(llff / "poses_bounds.npy", np.column_stack([poses, np.tile([5.0, 100.0], (len(poses), 1))]))


def _make_opensfm(folder: Path, scene: Path, posed: Any) -> None:
    import cv2
    from PIL import Image

    root, lens = folder / "opensfm", posed.lenses[0]
    (root / "images").mkdir(parents=True)
    shots, tracks = {}, ["OPENSFM_TRACKS_VERSION_v2"]
    longer = max(lens.width, lens.height)
    for i, (name, path, pose) in enumerate(zip(posed.names, posed.paths, posed.T_world_camera, strict=True)):
        jpeg = Path(name).with_suffix(".jpg").name
        Image.open(path).convert("RGB").save(root / "images" / jpeg)
        rotation = pose[:, :3].T
        shots[jpeg] = {
            "rotation": cv2.Rodrigues(rotation)[0][:, 0].tolist(),
            "translation": (-rotation @ pose[:, 3]).tolist(),
            "camera": "camera",
        }
        mine = posed.points.photograph_index == i
        for point, uv in list(zip(posed.points.point_index[mine], posed.points.uv_px[mine], strict=True))[:40]:
            x, y = (uv - (lens.width / 2, lens.height / 2)) / longer
            tracks.append(f"{jpeg}\t{point}\t{point}\t{x}\t{y}\t0.004\t10\t20\t30\t-1\t-1")
    brown = {"focal_x": lens.fx / longer, "focal_y": lens.fy / longer, "c_x": 0.0, "c_y": 0.0}
    camera = {"projection_type": "brown", "width": lens.width, "height": lens.height, **brown}
    camera |= dict.fromkeys(("k1", "k2", "k3", "p1", "p2"), 0.0)
    points = {
        str(k): {"coordinates": xyz.tolist(), "color": [120.0, 110.0, 90.0]}
        for k, xyz in enumerate(posed.points.xyz_world[:200])
    }
    top = [{"cameras": {"camera": camera}, "shots": shots, "points": points}]
    (root / "reconstruction.json").write_text(json.dumps(top))
    (root / "tracks.csv").write_text("\n".join(tracks) + "\n")
    place = {"longitude": _PLACE[0], "latitude": _PLACE[1], "altitude": 20.0}
    (root / "reference_lla.json").write_text(json.dumps(place))
    odm = folder / "odm"
    shutil.copytree(root / "images", odm / "photographs")
    (odm / "opensfm").mkdir()
    shutil.copy(root / "reconstruction.json", odm / "opensfm")
    (odm / "opensfm" / "image_list.txt").write_text("".join(f"../photographs/{name}\n" for name in shots))


def _make_survey_files(folder: Path) -> None:
    from PIL import Image
    from PIL.ExifTags import GPS, IFD, Base

    exif = Image.Exif()
    exif.update({Base.Make: "DJI", Base.Model: "FC330", Base.Orientation: 6, Base.DateTime: "2024:05:01 10:00:00"})
    exif[IFD.Exif] = {
        **{Base.FocalLength: 3.61, Base.FocalLengthIn35mmFilm: 20, Base.ExposureTime: 0.002, Base.FNumber: 2.8},
        **{Base.ISOSpeedRatings: 100, Base.DateTimeOriginal: "2024:05:01 10:00:00", Base.BodySerialNumber: "1"},
        **{Base.FocalPlaneXResolution: 649.0, Base.ExifImageWidth: 4000, Base.ExifImageHeight: 3000},
    }
    degrees = {GPS.GPSLatitudeRef: "N", GPS.GPSLatitude: (53.0, 36.0, 0.0), GPS.GPSLongitudeRef: "E"}
    exif[IFD.GPSInfo] = degrees | {GPS.GPSLongitude: (10.0, 30.0, 0.0), GPS.GPSAltitude: 100.0}
    properties = {
        **{"GimbalYawDegree": "+12.5", "GimbalPitchDegree": "-90.0", "GimbalRollDegree": "0.0"},
        **{"RelativeAltitude": "+80.0", "AbsoluteAltitude": "+100.0", "RtkFlag": "50", "RtkStdLon": "0.01"},
        **{"CalibratedFocalLength": "3666.66", "CalibratedOpticalCenterX": "2000", "CalibratedOpticalCenterY": "1500"},
        "DewarpData": "2024-01-01;3700.0,3700.0,10.0,-8.0,-0.1,0.02,0.001,-0.001,-0.01",
    }
    packet = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" '
        'xmlns:Camera="http://pix4d.com/camera/1.0/" '
        + " ".join(f'drone-dji:{name}="{value}"' for name, value in properties.items())
        + "><Camera:PrincipalPoint><rdf:Seq><rdf:li>3.1</rdf:li><rdf:li>2.2</rdf:li></rdf:Seq></Camera:PrincipalPoint>"
        "</rdf:Description></rdf:RDF></x:xmpmeta>"
    ).encode()
    metadata = folder / "metadata"
    metadata.mkdir()
    (metadata / "exif.bin").write_bytes(exif.tobytes())
    (metadata / "packet.xmp").write_bytes(packet)
    texture = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    for name in ("survey", "gps", "geo", "control"):
        (folder / name).mkdir()
        for file in ("a.jpg", "b b.jpg", "c.png", "d.tif"):
            options: dict[str, Any] = {"xmp": packet} if file.endswith("jpg") else {}
            Image.fromarray(texture).save(folder / name / file, exif=exif.tobytes(), **options)
    east, north = _PLACE
    rows = [(name, east + 1e-4 * k, north + 1e-4 * k) for k, name in enumerate(("a.jpg", "b b.jpg", "c.png", "d.tif"))]
    table = "".join(f'"{name}",{y:.6f},{x:.6f},100.5,0.02,0.03\n' for name, x, y in rows)
    header = "image_name,latitude [deg],longitude [deg],altitude [m],accuracy_horizontal,accuracy_vertical\n"
    (folder / "gps" / "gps.csv").write_text(header + table)
    lines = "".join(f"{name} {x:.6f} {y:.6f} 100.5 10 0 0 0.02 0.03\n" for name, x, y in rows)
    (folder / "geo" / "geo.txt").write_text("EPSG:4326\n# comment\n" + lines)
    marks = "".join(
        f"{600000 + 10 * point} {5940000 - 5 * point} 3.5 {10 + point} {8 + point} {name} point{point}\n"
        for point in range(4)
        for name, _, _ in rows
    )
    (folder / "control" / "gcp_list.txt").write_text("WGS84 UTM 32N\n" + marks)


def _make_prepared(folder: Path) -> None:
    """A survey with positions, and the scene that `tidefield prepare` makes of it."""
    from rich.console import Console

    from tidefield.commands.prepare import prepare
    from tidefield.geometry.geodesy import metres_per_degree
    from tidefield.synthetic import make_survey, write_survey

    survey = make_survey("ground_textures", seed=1, views=_SURVEY_VIEWS, width=_SURVEY_WIDTH, supersample=1)
    write_survey(survey, folder / "made", suffix=".jpg")
    (folder / "made" / "images").rename(folder / "photographs")
    shutil.rmtree(folder / "made")
    degrees = survey.cameras.position_world[:, :2].double().numpy() / metres_per_degree(_PLACE[1]) + _PLACE
    names = sorted(path.name for path in (folder / "photographs").iterdir())
    heights = survey.cameras.position_world[:, 2].tolist()
    lines = [f"{n},{y:.8f},{x:.8f},{z:.3f}" for n, (x, y), z in zip(names, degrees.tolist(), heights, strict=True)]
    (folder / "photographs" / "gps.csv").write_text("\n".join(["name,lat,lon,height", *lines]) + "\n")
    prepare(_prepare_options(folder), Console(file=StringIO()))


def _make_runs(folder: Path, scene: Path) -> None:
    import torch

    from tidefield.config import SWIFT, EncoderConfig
    from tidefield.data.load import load_scene
    from tidefield.methods import make_trainer
    from tidefield.train.checkpoint import Run, shipped_weights, write_run

    config = replace(SWIFT, network=replace(SWIFT.network, encoder=EncoderConfig((8, 8, 8, 8), (1, 1, 1), False)))
    run = folder / "run"
    run.mkdir()
    trainer = make_trainer(config, load_scene(scene), 0, torch.device("cpu"))
    for parameter in trainer.network.parameters():
        parameter.grad = torch.zeros_like(parameter)
    trainer.optimizer.step()
    write_run(run, Run(scene, None, 0, config))
    trainer.progress.losses = [0.5, 0.25]
    trainer.save(run)
    weights = shipped_weights("swift")
    assert weights is not None, "those of swift are part of the package"
    shutil.copytree(scene, folder / "weights" / "scene")
    shutil.copy(weights, folder / "weights" / "weights.safetensors")
    _make_comparison(folder / "comparison", scene)
    small = folder / "small"
    small.mkdir()
    (small / "validation.json").write_text(json.dumps([{"step": 500, "seconds": 9.5, "psnr": {"flat": 20.5}}]))
    job = {"method": "nerfacto", "out": "x", "steps": 5, "factor": [1.0, 1.0, 1.0], "trained": [5, 1.5]}
    (small / "job.json").write_text(json.dumps(job))
    (small / "opensplat").mkdir()
    (small / "opensplat" / "job.json").write_text(json.dumps({"factor": [1.0, 1.0, 1.0], "trained": [5, 1.5]}))
    _make_splats(small / "opensplat" / "splat.ply")
    made = {"files": ["scene/a", "view.mp4"], "unfinished": True}
    (small / "demonstration.json").write_text(json.dumps(made))


def _make_splats(path: Path) -> None:
    from plyfile import PlyData, PlyElement

    prefixes = {"f_dc_": 3, "f_rest_": 9, "opacity": 1, "scale_": 3, "rot_": 4}
    names = [*"xyz", *(f"{p}{k}" if p.endswith("_") else p for p, count in prefixes.items() for k in range(count))]
    vertex = np.random.default_rng(0).normal(size=(20, len(names))).astype(np.float32)
    vertex[:, 2] += 5
    table = np.rec.fromarrays(vertex.T, dtype=[(name, "<f4") for name in names])
    PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(path)


def _make_comparison(folder: Path, scene: Path) -> None:
    from tidefield.evaluation.evaluate import NAMES

    run = folder / "runs" / "flat" / "tidefield"
    run.mkdir(parents=True)
    shutil.copytree(scene, folder / "scene")
    name = sorted(path.name for path in (scene / "images").iterdir())[0]
    (run / "renderings").mkdir()
    shutil.copy(scene / "images" / name, run / "renderings" / name)
    mean = {metric: 0.5 for metric in NAMES} | {"reasons": {}, "seen_share": 0.9}
    evaluation = {
        "per_photograph": {name: mean},
        "mean": mean,
        "width": 64,
        "rays_per_second": 1000.5,
        "seconds_per_frame": 1.5,
        "lpips_weights": {},
        "configuration": {"run": "0" * 16, "trained": {"steps": 5, "seconds": 1.5}},
    }
    step = {"command": "tidefield", "seconds": 1.5, "peak_memory_bytes": 10**9}
    (run / "evaluation.json").write_text(json.dumps(evaluation))
    (run / "process.json").write_text(json.dumps({"settings": {"minutes": 1.0, "steps": None}, "train": step}))
    (run / "curve.json").write_text(json.dumps([[1.5, 20.5], [3.0, 22.5]]))
    (run / "run.json").write_text(json.dumps({"id": "0" * 16}))


def _make_path(folder: Path, posed: Any) -> None:
    path = folder / "path"
    shutil.copytree(folder / "transforms", path)
    frames = []
    for pose in posed.T_world_camera:
        matrix = np.vstack([pose * (1, -1, -1, 1), [0, 0, 0, 1]])
        frames.append({"camera_to_world": matrix.reshape(-1).tolist(), "fov": 50.0, "aspect": 1.33})
    size = {"render_width": 64, "render_height": 48, "fps": 24, "seconds": 2.0, "camera_type": "perspective"}
    (path / "path.json").write_text(json.dumps({**size, "camera_path": frames}))
    identity = np.eye(4)[:3].tolist()
    (path / "dataparser_transforms.json").write_text(json.dumps({"transform": identity, "scale": 1.0}))

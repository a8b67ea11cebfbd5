"""Tidefield inside nerfstudio: what its commands make of a scene, in nerfstudio's own environment."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from foreign_environment import run
from PIL import Image
from scenes_on_disk import FISHEYE, UTM, survey, write_colmap
from scipy.spatial import KDTree

from tidefield.config import PRESETS
from tidefield.data.georeference import Georeference, Residuals
from tidefield.data.load import load_scene, read_posed
from tidefield.data.readers.posed import every_eighth
from tidefield.data.scene import Scene
from tidefield.data.triangulate import triangulate_again
from tidefield.evaluation.evaluate import evaluate
from tidefield.geometry.geodesy import LocalFrame
from tidefield.geometry.similarity import Similarity
from tidefield.model.network import make_network
from tidefield.model.renderer import Renderer
from tidefield.synthetic import make_survey, write_survey

STEPS = 3


def georeference(scene: Path) -> LocalFrame:
    frame, none = LocalFrame.at("EPSG:27700", (400_000.0, 100_000.0, 3.0)), Residuals()
    Georeference(frame, "GPS", Similarity(1.0, np.eye(3), np.zeros(3)), none, none, none, (), ()).write(scene)
    return frame


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A scene, and what nerfstudio's commands wrote of it."""
    folder = tmp_path_factory.mktemp("nerfstudio")
    scene = folder / "scene"
    write_survey(make_survey("river_mouths", seed=2, views=10, width=96), scene)
    georeference(scene)
    options = f"--output-dir {folder} --vis tensorboard --timestamp t --machine.device-type cpu"
    options += f" --max-num-iterations {STEPS} --steps-per-eval-image 0 --steps-per-eval-all-images 0"
    out = folder / "scene/tidefield/t"
    config = ("--load-config", out / "config.yml")
    render = ("dataset", *config, "--output-path", folder / "views", "--rendered-output-names", "rgb")
    run(
        *("ns-train", "tidefield", "--data", scene, *options.split(), ":"),
        *("ns-eval", *config, "--output-path", folder / "eval.json", ":"),
        *("ns-render", *render, "--image-format", "png"),
    )
    return folder, out


@pytest.fixture(scope="module")
def evaluation(trained: tuple[Path, Path]) -> tuple[Scene, Path, float]:
    """What `tidefield evaluate` measures with the weights that ns-train saved."""
    folder, out = trained
    (checkpoint,) = (out / "nerfstudio_models").glob("*.ckpt")
    saved = torch.load(checkpoint, weights_only=True)["pipeline"]
    scene, config = load_scene(folder / "scene"), PRESETS["swift"]
    network, of_network = make_network(config.network), "_model.network."
    weights = {name.removeprefix(of_network): x for name, x in saved.items() if name.startswith(of_network)}
    network.load_state_dict(weights)
    render = Renderer(network.eval(), scene, config, torch.device("cpu"))
    return scene, folder / "own", evaluate(render, scene, folder / "own", configuration={}).mean["psnr"]


@pytest.mark.thorough
def test_ns_eval_measures_what_evaluate_measures(trained: tuple[Path, Path], evaluation: tuple[Scene, Path, float]):
    found = json.loads((trained[0] / "eval.json").read_text())["results"]["psnr"]
    assert found == pytest.approx(evaluation[2], abs=0.05)


@pytest.mark.thorough
def test_ns_render_shows_what_evaluate_shows(trained: tuple[Path, Path], evaluation: tuple[Scene, Path, float]):
    scene, own, _ = evaluation
    for name in (scene.names[i] for i in scene.test):
        pictures = [
            np.asarray(Image.open(folder / Path(name).name), dtype=int)
            for folder in (trained[0] / "views/test/rgb", own / "renderings")
        ]
        assert np.abs(pictures[0] - pictures[1]).mean() < 1


@pytest.mark.thorough
def test_the_run_holds_the_way_back_to_the_reference_system(trained: tuple[Path, Path]):
    folder, out = trained
    found = json.loads((out / "dataparser_transforms.json").read_text())
    assert LocalFrame.from_json(found["georeference"]) == georeference(folder / "scene")
    middle = read_posed(folder / "scene", False).T_world_camera[:, :, 3].mean(axis=0)
    np.testing.assert_allclose(np.array(found["transform"])[:, 3], -middle, rtol=0, atol=1e-12)  # not in float32


@pytest.fixture(scope="module")
def rays(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scene of each kind of lens, and with what nerfstudio's data parser makes of it."""
    folder, words = tmp_path_factory.mktemp("rays"), []
    for name, lenses in (("Brown", ()), ("fisheye", (FISHEYE,))):
        scene, truth = folder / name, survey(*lenses, offset=UTM)
        write_colmap(scene, truth)
        model = pycolmap.Reconstruction(scene / "sparse" / "0")
        for point in model.points3D.values():
            point.xyz, point.color = point.xyz + 0.3, np.array([1, 2, 3], np.uint8)
        model.write_binary(scene / "sparse" / "0")
        mask = scene / "masks" / f"{sorted(truth.names)[1]}.png"
        mask.parent.mkdir(parents=True)
        Image.new("L", (truth.lenses[1].width, truth.lenses[1].height), 0).save(mask)
        words += ["rays", scene, folder / f"{name}.json", ":"]
    run(*words)
    return folder


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["Brown", "fisheye"])
def test_the_data_parser_has_the_rays_of_the_lenses(rays: Path, name: str):
    truth, (mask,) = survey(*[FISHEYE] * (name == "fisheye"), offset=UTM), (rays / name / "masks").rglob("*.png")
    posed, train = read_posed(rays / name, False), every_eighth(9)[0]
    middle, pixel = posed.T_world_camera[:, :, 3].mean(axis=0), np.array([[50.0, 10.0]])
    found = json.loads((rays / f"{name}.json").read_text())
    for values, scale in ((found["metres"], 1.0), (found["scaled"], found["scaled"]["scale"])):
        assert values["files"] == [str(posed.paths[i]) for i in train]
        assert values["masks"][0] == str(mask)
        others = [np.asarray(Image.open(path)) for path in values["masks"][1:]]
        assert [other.min() for other in others] == [255] * (len(train) - 1), "nothing of the others is masked"
        for index, origin, direction in zip(train, values["origins"], values["directions"], strict=True):
            pose = posed.T_world_camera[index]
            np.testing.assert_allclose(origin, scale * (pose[:, 3] - middle), atol=1e-5)
            xy = posed.lenses[index].unproject(pixel)[0, :2]
            ray = pose[:, :3] @ np.array([*xy, 1.0])
            np.testing.assert_allclose(direction, ray / np.linalg.norm(ray), atol=2e-4)
        assert posed.points is not None
        pose = posed.T_world_camera.copy()
        pose[:, :, 3] -= middle
        own = replace(posed.points, xyz_world=posed.points.xyz_world - middle)
        expected = triangulate_again(own, pose, posed.lenses, train)
        np.testing.assert_allclose(values["points"], scale * expected.xyz_world, atol=1e-4)
        assert len(values["colours"]) == len(values["points"])
        assert [1, 2, 3] not in values["colours"], "of all photographs, the held-out ones included"
        off, _ = KDTree(truth.ground - middle).query(expected.xyz_world)
        assert off.max() < 0.05, "where all photographs put them is forgotten"
    reach = np.abs(posed.T_world_camera[:, :, 3] - middle).max()
    assert found["scaled"]["scale"] == pytest.approx(1 / reach), "positions reach to 1"

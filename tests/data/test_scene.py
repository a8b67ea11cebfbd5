"""Scenes and cameras: selection by photograph names, and short representations."""

from dataclasses import replace

import pytest
import textured_wall as wall
import torch

from tidefield.data.scene import Scene
from tidefield.errors import SceneError

NAMES = ("strip_1/DJI_0001.JPG", "strip_1/DJI_0002.JPG", "strip_2/DJI_0003.JPG", "strip_2/DJI_0004.JPG")


def named() -> Scene:
    return replace(wall.scene(wall.cameras(4)), names=NAMES)


@pytest.mark.parametrize("name", ["strip_2/DJI_0003.JPG", "DJI_0003.JPG", "DJI_0003"])
def test_cameras_are_selected_by_photograph_name(name: str):
    scene = named()
    assert scene.index(name) == 2
    camera = scene.cameras[name]
    assert len(camera) == 1
    assert camera.names == (NAMES[2],)
    assert torch.equal(camera.T_world_camera, scene.cameras.T_world_camera[2:3])


def test_an_unknown_name_is_an_error_with_some_names():
    scene = named()
    with pytest.raises(
        SceneError, match=r"no photograph named 'a\.jpg' in wall: names look like strip_1/DJI_0001\.JPG"
    ):
        scene.index("a.jpg")
    with pytest.raises(
        SceneError, match=r"no photograph named 'a\.jpg' in these cameras: names look like strip_1/DJI_0"
    ):
        scene.cameras["a.jpg"]
    with pytest.raises(SceneError, match="no names; use indices"):
        wall.cameras(4)["a.jpg"]


def test_a_name_in_another_case_is_found_and_one_that_is_misspelt_is_answered_by_the_nearest():
    names = ("DJI_0001.jpg", "dji_0001.JPG", "DJI_0017.jpg", "DJI_0025.jpg")
    scene = replace(named(), names=names)
    assert scene.index("DJI_0025.JPG") == 3
    assert scene.index("DJI_0001.jpg") == 0
    with pytest.raises(SceneError, match="names 2 photographs"):
        scene.index("Dji_0001")
    with pytest.raises(SceneError, match=r"names look like DJI_0025\.jpg"):
        scene.index("DJI_025.jpg")
    scene = replace(named(), names=tuple(f"100MEDIA/DJI_{k:04}.JPG" for k in (1, 2, 3, 25)))
    with pytest.raises(SceneError, match=r"names look like 100MEDIA/DJI_0025\.JPG"):
        scene.index("dji_025")


def test_a_name_of_several_photographs_is_an_error_unless_it_is_the_whole_name_of_one():
    names = ("100MEDIA/DJI_0001.JPG", "101MEDIA/DJI_0001.JPG", "101MEDIA/DJI_0002.JPG", "DJI_0002.JPG")
    scene = replace(named(), names=names)
    assert scene.index("DJI_0002.JPG") == 3
    assert scene.index("101MEDIA/DJI_0001.JPG") == 1
    assert scene.index("101MEDIA/DJI_0002") == 2
    with pytest.raises(SceneError, match=r"names 2 photographs in wall \(100MEDIA/DJI_0001\.JPG, 101MEDIA/DJI_0001"):
        scene.index("DJI_0001")


def test_names_follow_selections_except_those_by_tensors():
    cameras = named().cameras
    assert cameras[3].names == NAMES[3:]
    assert cameras[-1].names == NAMES[3:]
    assert cameras[1:3].names == NAMES[1:3]
    assert cameras[[2, 0]].names == (NAMES[2], NAMES[0])
    assert cameras[[2, 0]]["DJI_0001"].T_world_camera.equal(cameras[0].T_world_camera)
    assert cameras.to("cpu").names == cameras.resized(24, 18).names == cameras.cropped(40, 30).names == NAMES
    assert cameras[torch.tensor([1, 2])].names == ()
    assert wall.cameras(4)[1].names == ()


def test_cameras_of_a_scene_always_have_its_names():
    scene = named()
    assert replace(scene, cameras=wall.cameras(4)).cameras.names == NAMES
    assert replace(scene, names=NAMES[::-1]).cameras.names == NAMES[::-1]


def test_representations_are_one_short_line():
    scene = named()
    assert repr(scene) == "Scene('wall', 4 photographs 48x36, 3 train, 1 test, 400 points)"
    assert repr(replace(scene, points=None)).endswith("1 test, no points)")
    assert repr(scene.cameras) == "Cameras(4 of 48x36)"
    size = torch.tensor([[48, 36], [40, 36], [48, 36], [48, 36]])
    assert repr(replace(scene.cameras, size_px=size)) == "Cameras(4 of 2 sizes)"

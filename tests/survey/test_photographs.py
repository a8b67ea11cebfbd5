"""Folders of photographs are read as surveys; errors are reported."""

import math
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera_files import exif, named, one, photograph, real_survey, survey_folder
from PIL import Image
from PIL.ExifTags import IFD, Base

from tidefield.errors import SceneError, SurveyError
from tidefield.survey.export import write_images
from tidefield.survey.io import photographs
from tidefield.survey.io.photographs import read_survey
from tidefield.survey.sfm.features import initial_camera


def test_three_real_surveys_are_read_whole_and_without_remarks():
    for name, count in (("brighton_beach", 18), ("turin_lot", 32), ("swindale", 79)):
        survey = read_survey(real_survey(name))
        assert len(survey.photographs) == count
        assert survey.remarks == ()
        assert all(photograph.position and photograph.lens for photograph in survey.photographs)
        assert all(math.isfinite(photograph.time_s) for photograph in survey.photographs)


def test_photographs_are_found_in_sub_folders_with_any_suffix_and_name(tmp_path):
    names = ["100MEDIA/DJI 0001.JPG", "101MEDIA/DJI 0001.JPG", "Watt, Süd/Priel №3.jpeg", "b.TIFF", "潮汐.png"]
    for name in names:
        photograph(tmp_path / name)
    for name in (".cache/x.jpg", "@eaDir/x.jpg", "scene/images/x.jpg", "._DJI 0001.JPG", "odm_orthophoto/x.tif"):
        photograph(tmp_path / name)
    (tmp_path / "scene/sparse/0").mkdir(parents=True)
    (tmp_path / "notes.txt").write_text("windy")
    survey = read_survey(tmp_path)
    assert [photograph.name for photograph in survey.photographs] == sorted(names)
    assert all(photograph.path.is_file() for photograph in survey.photographs)


def test_photographs_in_folders_that_look_like_results_are_counted_and_results_are_not(tmp_path: Path):
    camera, card = exif({Base.Model: "M1"}), survey_folder(tmp_path / "card")
    for name in ("odm_flight 2/DJI_0000.JPG", "odm_flight 2/DJI_0001.JPG", "a/flight 3/DJI_0000.JPG"):
        photograph(card / name, table=camera)
    for name in ("colmap/images/DJI_0000.JPG", "scene/images/z.jpg", "imported/images/z.jpg", "opensfm/.x/z.jpg"):
        photograph(card / name, table=camera)
    for name in ("odm_texturing/z.png", "odm_orthophoto/z.tif", "opensfm/undistorted/images/z.jpg"):
        photograph(card / name)
    for folder in ("a/flight 3", "colmap", "scene", "imported"):
        (card / folder / "sparse").mkdir()
    (card / "scene" / "georeference.json").write_text("{}")
    (card / "imported" / "transforms.json").write_text("{}")
    survey = read_survey(card)
    assert len(survey.photographs) == 4
    first, second = survey.remarks
    assert first.startswith("1 photographs in a/flight 3 are not read, because it looks like results of ODM or a scene")
    assert second.startswith("2 photographs in odm_flight 2 are not read")
    for path in card.glob("*.JPG"):
        path.unlink()
    with pytest.raises(SurveyError, match=r"has no photographs(.|\n)*2 photographs in odm_flight 2 are not read"):
        read_survey(card)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photograph_has_its_upright_size(tmp_path, orientation):
    turned = one(tmp_path, size=(64, 48), table=exif({Base.Orientation: orientation}))
    assert turned.orientation == orientation
    assert (turned.width, turned.height) == ((64, 48) if orientation < 5 else (48, 64))


def test_raw_files_alone_are_to_be_developed_first(tmp_path):
    for name in ("a.DNG", "b.cr3", "sub/c.NEF"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"II*\0")
    with pytest.raises(SurveyError, match=r"3 camera raw files \(a.DNG, b.cr3, sub/c.NEF\).*develop them first"):
        read_survey(tmp_path)


def test_raw_files_next_to_photographs_are_reported(tmp_path):
    (survey_folder(tmp_path) / "DJI_0001.DNG").write_bytes(b"II*\0")
    survey = read_survey(tmp_path)
    assert len(survey.photographs) == 4
    assert any("DJI_0001.DNG" in remark and "develop" in remark for remark in survey.remarks)


def test_a_folder_that_does_not_exist_or_has_no_photographs_is_an_error(tmp_path):
    with pytest.raises(SurveyError, match="does not exist: expected a folder"):
        read_survey(tmp_path / "gone")
    (tmp_path / "file").write_text("")
    with pytest.raises(SurveyError, match="is a file: expected a folder"):
        read_survey(tmp_path / "file")
    with pytest.raises(SurveyError, match="has no photographs"):
        read_survey(tmp_path)
    (tmp_path / "a.webp").write_bytes(b"")
    with pytest.raises(SurveyError, match=r"images of other formats \(a.webp\)"):
        read_survey(tmp_path)


def test_two_photographs_are_too_few(tmp_path):
    with pytest.raises(SurveyError, match="has 2 photographs that can be read: expected at least 3"):
        read_survey(survey_folder(tmp_path, count=2))


def spoil(folder: Path) -> list[str]:
    """Files that cannot be read, each in its way."""
    for name in ("cut.jpg", "cut.png", "cut_too.tif"):
        path = photograph(folder / name, size=(200, 150))
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    (folder / "cut.jpg").rename(folder / "truncated.jpg")
    (folder / "empty.jpg").write_bytes(b"")
    (folder / "page.jpg").write_text("<html>not found</html>")
    (folder / "header.jpg").write_bytes(b"\xff\xd8\xff")
    return ["cut.png", "cut_too.tif", "empty.jpg", "header.jpg", "page.jpg", "truncated.jpg"]


def test_files_that_cannot_be_read_are_left_out_and_named(tmp_path):
    spoiled = spoil(survey_folder(tmp_path))
    survey = read_survey(tmp_path)
    assert len(survey.photographs) == 4
    for name in spoiled:
        assert any(f"Left out: {tmp_path / name} cannot be read" in remark for remark in survey.remarks), name
    assert any("empty.jpg cannot be read (it is empty)" in remark for remark in survey.remarks)
    assert any("truncated.jpg cannot be read (its end is missing)" in remark for remark in survey.remarks)


def test_too_few_files_that_can_be_read_is_an_error_that_names_the_others(tmp_path):
    spoil(survey_folder(tmp_path, count=1))
    with pytest.raises(SurveyError, match=r"has 1 photograph that can be read(.|\n)*empty.jpg"):
        read_survey(tmp_path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_a_file_without_read_permission_is_left_out(tmp_path):
    (survey_folder(tmp_path) / "DJI_0000.JPG").chmod(0)
    assert any("DJI_0000.JPG cannot be read (Permission denied)" in r for r in read_survey(tmp_path).remarks)


@pytest.mark.parametrize("other", ["DJI_0001.png", "dji_0001.jpg", "DJI_0001.JPEG"])
def test_two_files_of_one_name_are_an_error(tmp_path, other):
    photograph(survey_folder(tmp_path) / other)
    with pytest.raises(SurveyError, match=r"DJI_0001.JPG.* differ in their suffix or in upper and lower case"):
        read_survey(tmp_path)


def test_the_end_mark_of_a_thumbnail_does_not_make_a_truncated_photograph_whole(tmp_path):
    path = photograph(survey_folder(tmp_path) / "with thumbnail.jpg", size=(200, 150))
    data = path.read_bytes()
    thumbnail = photograph(tmp_path / "thumb.jpg").read_bytes()
    segment = b"\xff\xe5" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    path.write_bytes(data[:2] + segment + data[2:])
    assert named(read_survey(tmp_path), "with thumbnail.jpg").width == 200
    path.write_bytes((data[:2] + segment + data[2:])[:-1000])
    assert any("with thumbnail.jpg cannot be read (its end" in remark for remark in read_survey(tmp_path).remarks)


def test_equal_surveys_are_equal_however_many_threads_read_them(tmp_path):
    survey_folder(tmp_path, count=20)
    first, second = (read_survey(tmp_path) for _ in range(2))
    assert [repr(p) for p in first.photographs] == [repr(p) for p in second.photographs]
    assert replace(first, photographs=()) == replace(second, photographs=())


def test_the_first_of_several_pictures_in_a_file_is_the_photograph(tmp_path):
    survey_folder(tmp_path, count=2)
    pictures = [Image.new("RGB", size) for size in ((80, 60), (40, 30))]
    pictures[0].save(tmp_path / "m.jpg", format="MPO", save_all=True, append_images=pictures[1:])
    assert (named(read_survey(tmp_path), "m.jpg").width) == 80


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")
def test_a_pipe_among_photographs_is_left_out_and_not_waited_for(tmp_path):
    survey_folder(tmp_path, 3)
    os.mkfifo(tmp_path / "pipe.jpg")
    assert any("pipe.jpg" in remark and "no regular file" in remark for remark in read_survey(tmp_path).remarks)


def test_a_name_that_is_not_utf_8_is_refused_and_shown(tmp_path):
    survey_folder(tmp_path, 3)
    try:
        (tmp_path / os.fsdecode(b"caf\xe9.jpg")).write_bytes(b"")
    except OSError:
        pytest.skip("this file system has names in Unicode only")
    with pytest.raises(SurveyError, match=r"not UTF-8, caf\\xe9.jpg: expected .*; rename it"):
        read_survey(tmp_path)


def mask(path: Path, size: tuple[int, int] = (64, 48)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", size, 255).save(path)


def test_masks_next_to_the_photographs_are_used_and_are_no_photographs(tmp_path: Path):
    for name in ("a.jpg", "sub/b.jpg", "c.png"):
        photograph(tmp_path / name)
    size = read_survey(tmp_path).photographs[0].width, read_survey(tmp_path).photographs[0].height
    mask(tmp_path / "masks" / "a.jpg.png", size)
    mask(tmp_path / "masks" / "sub" / "b.jpg.png", size)
    mask(tmp_path / "masks" / "of one that was removed.jpg.png")
    survey = read_survey(tmp_path)
    assert {p.name: p.mask and p.mask.name for p in survey.photographs} == {
        "a.jpg": "a.jpg.png",
        "c.png": None,
        "sub/b.jpg": "b.jpg.png",
    }
    assert f"{tmp_path / 'masks'} has masks of 2 photographs: what is black there is not used." in survey.remarks


def test_a_folder_called_masks_without_masks_is_one_of_photographs(tmp_path: Path):
    for name in ("masks/a.jpg", "masks/b.png", "masks/c.png"):
        photograph(tmp_path / name)
    assert len(read_survey(tmp_path).photographs) == 3


@pytest.mark.parametrize("mode", ["L", "P", "1"])
@pytest.mark.parametrize("name", ["{}_mask.png", "{}.JPG"])
def test_a_folder_of_masks_by_other_names_is_refused_and_holds_no_photographs(tmp_path: Path, mode: str, name: str):
    survey_folder(tmp_path)
    (tmp_path / "masks").mkdir()
    for k in range(4):
        path = tmp_path / "masks" / name.format(f"DJI_{k:04d}")
        Image.new("L" if path.suffix == ".JPG" else mode, (64, 48), 255).save(path)
    with pytest.raises(
        SurveyError, match=r"masks has no mask of any photograph.*such as DJI_0000.JPG.png.*rename them"
    ):
        read_survey(tmp_path)


def test_masks_that_belong_to_no_photograph_are_counted(tmp_path: Path):
    survey_folder(tmp_path / "card")
    for name in ("DJI_0000.png", "DJI_0001_mask.png", "DJI_0002.JPG", "._DJI_0003.png"):
        mask(tmp_path / "card" / "masks" / name)
    shutil.copytree(tmp_path / "card" / "masks", tmp_path / "elsewhere")
    for masks, home in ((None, "card/masks"), (tmp_path / "elsewhere", "elsewhere")):
        survey = read_survey(tmp_path / "card", masks=masks)
        assert sum(p.mask is not None for p in survey.photographs) == 1
        counted = f"2 of the 3 pictures in {tmp_path / home} belong to no photograph and are not used"
        assert any(f"{counted} (DJI_0001_mask.png, DJI_0002.JPG)" in remark for remark in survey.remarks)


def test_photographs_in_the_folder_of_the_masks_are_none_of_them(tmp_path: Path):
    survey_folder(tmp_path / "images")
    for name in ("DJI_0000.JPG.png", "@eaDir/DJI_0001.jpg"):
        mask(tmp_path / name)
    survey = read_survey(tmp_path / "images", masks=tmp_path)
    assert sum(p.mask is not None for p in survey.photographs) == 1
    assert not any("belong to no photograph" in remark for remark in survey.remarks)


@pytest.mark.parametrize(
    ("folder", "masks"),
    [("images", "{}"), ("{}/images", "."), ("images", "../here"), ("{}/link/images", "{}"), ("images", "link")],
)
def test_the_folder_of_the_masks_holds_photographs_by_whatever_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, masks: str
):
    here = tmp_path / "here"
    survey_folder(here / "images")
    mask(here / "DJI_0000.JPG.png")
    (here / "link").symlink_to(here)
    monkeypatch.chdir(here)
    survey = read_survey(Path(folder.format(here)), masks=Path(masks.format(here)))
    assert [p.mask is not None for p in survey.photographs] == [True, False, False, False]
    assert len(survey.remarks) == 1
    assert "1 of the photographs have masks" in survey.remarks[0]


@pytest.mark.parametrize(("folder", "masks"), [(".", "{}/masks"), ("{}", "masks"), ("../here", "masks")])
def test_masks_in_the_folder_of_the_photographs_are_none_by_whatever_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, masks: str
):
    here = survey_folder(tmp_path / "here")
    for k in range(4):
        mask(here / "masks" / f"DJI_{k:04d}.JPG.png")
    mask(here / "masks" / "DJI_0009.JPG.png")
    monkeypatch.chdir(here)
    survey = read_survey(Path(folder.format(here)), masks=Path(masks.format(here)))
    assert [p.mask is not None for p in survey.photographs] == [True] * 4
    assert len(survey.remarks) == 1
    assert "1 of the 5 pictures" in survey.remarks[0]


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="there are no users")
def test_a_folder_next_to_the_masks_that_may_not_be_read_is_no_error(tmp_path: Path):
    survey_folder(tmp_path / "card")
    mask(tmp_path / "disk" / "DJI_0000.JPG.png")
    (tmp_path / "disk" / "lost+found").mkdir(mode=0)
    user, parents = os.geteuid(), {p: p.stat().st_mode for p in tmp_path.parents if "pytest" in str(p)}
    for path in (tmp_path, *parents) if user == 0 else ():
        path.chmod(0o755)
    read_survey(tmp_path / "card")  # which imports what only root may read
    os.seteuid(user or 54321)  # root may read everything
    try:
        survey = read_survey(tmp_path / "card", masks=tmp_path / "disk")
    finally:
        os.seteuid(user)
        for path, mode in parents.items():
            path.chmod(mode)
    assert sum(p.mask is not None for p in survey.photographs) == 1


def test_grey_photographs_of_a_camera_in_a_folder_called_masks_are_photographs(tmp_path: Path):
    survey_folder(tmp_path, 3)
    for k in range(3):
        photograph(
            tmp_path / "masks" / f"{k}.jpg", table=exif({Base.Model: "M1"}), pixels=np.full((48, 64), 99, np.uint8)
        )
    assert len(read_survey(tmp_path).photographs) == 6


def test_linked_folders_and_pictures_of_other_formats_are_remarked(tmp_path: Path):
    card = survey_folder(tmp_path / "card")
    for name in ("x.webp", "sub/y.bmp", "z.gif"):
        (card / name).parent.mkdir(exist_ok=True)
        Image.new("RGB", (64, 48)).save(card / name)
    survey_folder(tmp_path / "elsewhere", 1)
    mask(tmp_path / "drawn" / "DJI_0000.png")
    (card / "sub" / "flight 2").symlink_to(tmp_path / "elsewhere")
    (card / "masks").symlink_to(tmp_path / "drawn")
    survey = read_survey(card)
    assert len(survey.photographs) == 4
    assert survey.photographs[0].mask is not None
    assert survey.remarks[1:] == (
        "3 pictures of other formats are not read (sub/y.bmp, x.webp, z.gif): convert them to JPEG, PNG or TIFF.",
        "1 linked folders are not followed (sub/flight 2): move the photographs, or give the folder that has them.",
    )


def test_masks_may_lie_elsewhere_or_among_the_photographs(tmp_path: Path):
    card = tmp_path / "card"
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        photograph(card / name)
    size = read_survey(card).photographs[0].width, read_survey(card).photographs[0].height
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        mask(tmp_path / "elsewhere" / f"{name}.png", size)
    survey = read_survey(card, masks=tmp_path / "elsewhere")
    assert all(p.mask for p in survey.photographs)
    assert not any("masks" in remark for remark in survey.remarks)
    mask(card / "a.jpg.png", size)
    survey = read_survey(card, masks=card)
    assert [p.mask is not None for p in survey.photographs] == [True, False, False]
    assert "1 of the photographs have masks" in survey.remarks[0]


def test_a_mask_may_have_the_stem_of_its_photograph(tmp_path: Path):
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        photograph(tmp_path / "card" / name)
    size = read_survey(tmp_path / "card").photographs[0].width, read_survey(tmp_path / "card").photographs[0].height
    for name in ("a.png", "c.png", "c.jpg.png"):
        mask(tmp_path / "card" / "masks" / name, size)
    survey = read_survey(tmp_path / "card")
    found = {p.name: p.mask.name if p.mask else None for p in survey.photographs}
    assert found == {"a.jpg": "a.png", "b.jpg": None, "c.jpg": "c.jpg.png"}


def test_masks_that_do_not_fit_are_errors(tmp_path: Path):
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        photograph(tmp_path / "card" / name)
    mask(tmp_path / "other" / "d.png")
    with pytest.raises(SurveyError, match=r"has no mask of any photograph in .*: expected a PNG .*such as a.jpg.png"):
        read_survey(tmp_path / "card", masks=tmp_path / "other")
    mask(tmp_path / "card" / "masks" / "a.jpg.png", (7, 5))
    with pytest.raises(SceneError, match=r"a.jpg.png has 7 x 5 pixels, but its photograph .*a.jpg has"):
        read_survey(tmp_path / "card")


def heic(path: Path, pixels: np.ndarray) -> None:
    pillow_heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed (the extra [heic])")
    table = exif({Base.Model: "Phone", Base.FocalLength: 5.7}, place=(54.5, -2.7))
    picture = pillow_heif.from_pillow(Image.fromarray(pixels))
    picture.save(path, quality=90, exif=table.tobytes())


def test_heic_photographs_are_read_and_written_as_jpeg_with_their_exif(tmp_path: Path):
    ramp = np.stack(np.broadcast_arrays(*np.ogrid[60:180:2, 40:200:2], 90), -1).astype(np.uint8)
    for name in ("a.HEIC", "b.heif", "c.heic"):
        heic(tmp_path / name, ramp)
    survey = read_survey(tmp_path)
    assert [p.name for p in survey.photographs] == ["a.jpg", "b.jpg", "c.jpg"]
    first = survey.photographs[0]
    assert (first.width, first.height, first.orientation, first.camera) == (80, 60, 1, "Phone")
    assert first.position is not None
    assert first.position.latitude_deg == pytest.approx(54.5)
    write_images(
        survey.photographs, tmp_path / "images", None, [initial_camera(p) for p in survey.photographs], lambda *_: None
    )
    with Image.open(tmp_path / "images" / "a.jpg") as written:
        assert written.format == "JPEG"
        assert written.getexif()[Base.Model] == "Phone"
        assert written.getexif().get_ifd(IFD.GPSInfo)[2][0] == 54
        assert np.abs(np.asarray(written).astype(int) - ramp).max() < 12


def test_heic_photographs_without_the_extra_are_one_error_that_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for name in ("a.HEIC", "b.heic", "c.heic"):
        (tmp_path / name).write_bytes(b"....ftypheic")
    monkeypatch.setattr(photographs, "find_spec", lambda name: None)
    with pytest.raises(SurveyError, match=r"3 photographs are HEIC files \(a.HEIC.*pip install 'tidefield\[heic\]'"):
        read_survey(tmp_path)


def test_a_damaged_heic_photograph_is_left_out(tmp_path: Path):
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        photograph(tmp_path / name)
    heic(tmp_path / "d.heic", np.zeros((48, 64, 3), dtype=np.uint8))
    whole = (tmp_path / "d.heic").read_bytes()
    (tmp_path / "d.heic").write_bytes(whole[: len(whole) // 2])
    survey = read_survey(tmp_path)
    assert [p.name for p in survey.photographs] == ["a.jpg", "b.jpg", "c.jpg"]
    assert any("d.heic cannot be read" in remark for remark in survey.remarks)


def test_a_heic_photograph_by_another_suffix_is_left_out_and_to_be_renamed(tmp_path: Path):
    survey_folder(tmp_path)
    (tmp_path / "e.jpg").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
    survey = read_survey(tmp_path)
    assert len(survey.photographs) == 4
    wrong = f"Left out: {tmp_path / 'e.jpg'} is an HEIC file: expected a name that ends in .heic; rename it"
    assert wrong in survey.remarks


@pytest.mark.parametrize(("without", "kept"), [(0, 18), (1, 18), (2, 18), (3, 21)])
def test_few_photographs_without_a_focal_length_are_left_out(tmp_path: Path, without: int, kept: int):
    for k in range(18):
        photograph(tmp_path / f"{k:02d}.jpg", table=exif({Base.FocalLengthIn35mmFilm: 24}))
    for k in range(without):
        photograph(tmp_path / f"other {k}.jpg")
    survey = read_survey(tmp_path)
    assert len(survey.photographs) == kept
    assert all(one.lens is not None for one in survey.photographs) == (kept == 18)
    left_out = [remark for remark in survey.remarks if "do not state their focal length and are left out" in remark]
    assert len(left_out) == (0 < without < 3)
    assert all(f"{without} of {18 + without} photographs" in remark and "other 0.jpg" in remark for remark in left_out)

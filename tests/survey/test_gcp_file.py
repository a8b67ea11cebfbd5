"""Ground control is read from ODM's gcp_list.txt; errors, and control of another site, are refused."""

import re
from pathlib import Path

import pytest
from camera_files import exif, photograph, real_survey, survey_folder
from PIL.ExifTags import Base
from pyproj import Transformer

from tidefield.errors import SurveyError
from tidefield.survey.io.gcp_file import read_control, refuse_elsewhere
from tidefield.survey.io.photographs import read_survey
from tidefield.survey.survey import Control, Mark

UTM = "EPSG:32615"
HERE = -2.752, 54.512
POINTS = [(576640.25, 5188050.5, 183.1), (576650.75, 5188060.25, 184.2)]


def control(folder: Path, text: str, name: str = "gcp_list.txt") -> tuple[Control, list[str]]:
    """Read a control file of the photographs in a folder."""
    path = folder / name
    path.write_bytes(text.encode())
    survey = read_survey(folder, control=path)
    assert survey.control is not None
    again, remarks = read_control(path, survey.photographs)
    assert again == survey.control
    assert set(remarks) <= set(survey.remarks)
    return again, remarks


def line(point: int, uv: tuple[float, float], rest: str, separator: str = " ") -> str:
    return separator.join([*map(str, POINTS[point]), *map(str, uv), rest]) + "\n"


def test_the_control_file_of_swindale_is_found():
    survey = read_survey(real_survey("swindale"))
    assert survey.control is not None
    assert survey.control.crs == "EPSG:27700"
    assert len(survey.control.points) == 10
    assert len(survey.control.marks) == 36
    assert survey.control.points["StkdT_12385"] == (351139.7462, 512875.7537, 264.3243)
    assert survey.control.marks[0] == Mark("StkdT_12385", "IMG_1429.jpg", (1205.21, 768.45))


@pytest.mark.parametrize("header", [UTM, "epsg:32615", "WGS84 UTM 15N", "+proj=utm +zone=15 +datum=WGS84 +units=m"])
@pytest.mark.parametrize("separator", [" ", "\t"])
def test_a_list_is_read_with_any_header_and_separator(tmp_path, header, separator):
    text = "\ufeff# surveyed in May\n" + header + "\r\n\n# two points\n"
    text += line(0, (10.5, 20.25), f"DJI_0000.JPG{separator}A", separator)
    text += line(0, (12, 21), f"DJI_0001.JPG{separator}A", separator)
    text += line(1, (30, 40), f"dji_0001{separator}B 2", separator)
    found, remarks = control(survey_folder(tmp_path), text)
    assert remarks == []
    second = "B 2" if separator == "\t" else "B"  # further words are ODM's extras
    assert found.points == {"A": POINTS[0], second: POINTS[1]}
    assert found.marks == (
        Mark("A", "DJI_0000.JPG", (10.5, 20.25)),
        Mark("A", "DJI_0001.JPG", (12.0, 21.0)),
        Mark(second, "DJI_0001.JPG", (30.0, 40.0)),
    )


@pytest.mark.parametrize(("crs", "remarked"), [("EPSG:26849", True), ("EPSG:26849+6360", False), (UTM, False)])
def test_heights_of_a_system_in_feet_without_a_vertical_one_are_remarked(tmp_path, crs, remarked):
    x, y = Transformer.from_crs(UTM, crs.partition("+")[0], always_xy=True).transform(*POINTS[0][:2])
    _, remarks = control(survey_folder(tmp_path), f"{crs}\n{x} {y} 600.5 1 2 DJI_0000.JPG A\n")
    assert [remark for remark in remarks if "taken in metres, as ODM does" in remark] == remarks
    assert len(remarks) == remarked


def test_points_without_names_are_distinguished_by_position(tmp_path):
    lines = line(0, (1, 2), "DJI_0000.JPG") + line(1, (3, 4), "DJI_0000.JPG") + line(0, (5, 6), "DJI_0001.JPG")
    found, _ = control(survey_folder(tmp_path), UTM + "\n" + lines)
    assert found.points == {"point 1": POINTS[0], "point 2": POINTS[1]}
    assert [mark.point for mark in found.marks] == ["point 1", "point 2", "point 1"]


@pytest.mark.parametrize("marked", [(" gcp1", " GCP1"), ("", " CHK1"), (" CHK1", "")])
def test_a_surveyed_point_with_two_names_is_one_point(tmp_path, marked):
    """Its twin would otherwise stay in the model while its accuracy is measured without it."""
    lines = "".join(line(0, (1, 2 + k), f"DJI_000{k}.JPG{name}") for k, name in enumerate(marked))
    found, remarks = control(survey_folder(tmp_path), UTM + "\n" + lines)
    one = next(name for name in marked if name).strip()
    assert found.points == {one: POINTS[0]}
    assert [mark.point for mark in found.marks] == [one, one]
    twice = ["gcp_list.txt: GCP1 has the coordinates of gcp1, and is taken for it."]
    assert remarks == (twice if all(marked) else [])


def test_names_with_spaces_are_those_of_photographs(tmp_path):
    for name in ("Watt Süd 1.jpg", "sub/Watt Süd 2.jpg", "Watt.jpg"):
        photograph(tmp_path / name)
    lines = line(0, (1, 2), "Watt Süd 1.jpg") + line(1, (1, 3), "sub/Watt Süd 2.jpg  P 7") + line(1, (4, 5), "Watt P")
    found, _ = control(tmp_path, UTM + "\n" + lines)
    assert [(mark.point, mark.photograph) for mark in found.marks] == [
        ("point 1", "Watt Süd 1.jpg"),
        ("P", "sub/Watt Süd 2.jpg"),
        ("P", "Watt.jpg"),
    ]


@pytest.mark.parametrize(
    ("orientation", "upright"), [(1, (10.0, 20.0)), (3, (54.0, 28.0)), (6, (28.0, 10.0)), (8, (20.0, 54.0))]
)
def test_marks_refer_to_the_stored_image(tmp_path, orientation, upright):
    survey_folder(tmp_path, place=None)
    photograph(tmp_path / "turned.jpg", (64, 48), exif({Base.Orientation: orientation}))
    found, _ = control(tmp_path, UTM + "\n" + line(0, (10, 20), "turned.jpg A"))
    assert found.marks == (Mark("A", "turned.jpg", upright),)


def test_marks_in_missing_photographs_are_left_out_and_reported(tmp_path):
    lines = line(0, (1, 2), "DJI_0000.JPG A") + line(1, (3, 4), "IMG 7.JPG B") + line(0, (5, 6), "gone.JPG A")
    found, remarks = control(survey_folder(tmp_path), UTM + "\n" + lines)
    assert list(found.points) == ["A"]
    assert len(found.marks) == 1
    assert remarks == [
        "gcp_list.txt marks points in photographs that are not among the survey's (left out): IMG 7.JPG, gone.JPG."
    ]


def test_marks_outside_their_photograph_are_left_out_and_reported(tmp_path):
    lines = (line(0, uv, f"DJI_000{index}.JPG A") for index, uv in enumerate(((1, 2), (3, 4), (70, 4))))
    found, remarks = control(survey_folder(tmp_path), UTM + "\n" + "".join(lines))
    assert len(found.marks) == 2
    outside = "the mark of A at (70, 4) is outside of DJI_0002.JPG (64 x 48 pixels)"
    assert remarks == [f"gcp_list.txt: {outside} and is left out."]


def test_the_same_line_twice_is_one_mark(tmp_path):
    found, _ = control(survey_folder(tmp_path), UTM + "\n" + 2 * line(0, (1, 2), "DJI_0000.JPG A"))
    assert len(found.marks) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the first line of .* is '': expected a projected or geographic coordinate reference system"),
        (line(0, (1, 2), "DJI_0000.JPG A"), "the first line .* write one"),
        ("EPSG:99999\n" + line(0, (1, 2), "DJI_0000.JPG A"), "is 'EPSG:99999': expected a projected or geographic"),
        (UTM, "has no ground control points: expected `x y z px py image"),
        (UTM + "\n1 2 3 4 DJI_0000.JPG A", "line 2 is '1 2 3 4 DJI_0000.JPG A': expected `x y z px py image"),
        (UTM + "\n1 2 nan 4 5 DJI_0000.JPG A", "line 2 is .*: expected `x y z px py image"),
        (UTM + "\n1 2 3 4 5", "line 2 is '1 2 3 4 5': expected"),
        (
            UTM + "\n" + line(0, (1, 2), "a.JPG A") + line(0, (3, 4), "b 1.JPG A"),
            r"marks points in 2 photographs \(a.JPG, b 1.JPG\), none of which exists",
        ),
        (
            UTM + "\n" + line(0, (1, 2), "DJI_0000.JPG A") + line(1, (3, 4), "DJI_0001.JPG A"),
            r"line 3 puts the point A at \(576650.75, .*line 2 at \(576640.25.*expected one position per point",
        ),
        (
            UTM + "\n" + line(0, (1, 2), "DJI_0000.JPG A") + line(0, (3, 4), "DJI_0000.JPG A"),
            "line 3 marks A in DJI_0000.JPG a second time",
        ),
        (
            UTM + "\n" + line(0, (1205, 768), "DJI_0000.JPG A"),
            r"1 of 1 marks are outside .*\(64 x 48 pixels\).*resized, scale the marks",
        ),
        ("EPSG:27700\n" + line(0, (1, 2), "DJI_0000.JPG A"), "from the photographs|nowhere near the photographs"),
        (
            UTM
            + "\n"
            + line(0, (1, 2), "DJI_0000.JPG A")
            + line(1, (3, 4), "DJI_0000.JPG B")
            # A point is missing in the easting.
            + "57664025 5188211.19 2000 7 8 DJI_0000.JPG D",
            r"line 4 puts the point D at \(57664025, 5188211.19\), which is nowhere in WGS 84 / UTM zone",
        ),
    ],
)
def test_a_list_that_cannot_be_right_is_an_error(tmp_path, text, message):
    with pytest.raises(SurveyError, match=message):
        control(survey_folder(tmp_path), text)


def test_another_encoding_and_a_missing_file_are_errors(tmp_path):
    survey_folder(tmp_path)
    (tmp_path / "gcp_list.txt").write_bytes((UTM + "\n" + line(0, (1, 2), "Süd.jpg A")).encode("utf-16"))
    with pytest.raises(SurveyError, match=r"gcp_list.txt is not in UTF-8"):
        read_survey(tmp_path, control=tmp_path / "gcp_list.txt")
    with pytest.raises(SurveyError, match=r"none.txt cannot be read"):
        read_survey(tmp_path, control=tmp_path / "none.txt")


def test_rounding_of_a_printed_coordinate_is_tolerated(tmp_path):
    again = line(0, (3, 4), "DJI_0001.JPG A").replace("183.1", "183.1004")
    found, _ = control(survey_folder(tmp_path), UTM + "\n" + line(0, (1, 2), "DJI_0000.JPG A") + again)
    assert found.points == {"A": POINTS[0]}


def test_control_in_degrees_is_longitude_before_latitude(tmp_path):
    x, y = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(*POINTS[0][:2])
    found, _ = control(survey_folder(tmp_path), f"EPSG:4326\n{x:.8f} {y:.8f} 183.1 1 2 DJI_0000.JPG A\n")
    assert found.points["A"][0] == pytest.approx(-92, abs=0.1)


def refusal(crs: str, x: float, y: float, here: tuple[float, float] = HERE) -> str:
    with pytest.raises(SurveyError) as caught:
        refuse_elsewhere(Control(crs, {"G1": (x, y, 260.0), "G2": (x, y, 261.0)}, ()), *here)
    return str(caught.value)


@pytest.mark.parametrize(
    ("here", "mistake"),
    [
        ((-HERE[0], HERE[1]), "the sign of their longitudes were the other"),
        ((HERE[0], -HERE[1]), "the sign of their latitudes were the other"),
        ((HERE[1], HERE[0]), "their latitudes and longitudes were exchanged"),
    ],
)
def test_photographs_with_mirrored_positions_are_at_fault_and_not_the_control(here, mistake):
    message = refusal("EPSG:27700", 351139.0, 512875.0, here)
    assert f"the photographs would be there if {mistake}; correct their positions" in message
    assert "correct the control file" not in message


def test_control_of_the_same_site_is_accepted():
    refuse_elsewhere(Control("EPSG:27700", {"G1": (351139.0, 512875.0, 264.0)}, ()), *HERE)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("crs", "x", "y", "expected"),
    [
        ("EPSG:32630", 351139.0, 512875.0, "EPSG:27700 (OSGB36 / British National Grid)"),
        ("EPSG:27700", 512875.0, 351139.0, "British National Grid), with the two coordinates swapped"),
        ("EPSG:32631", 516100.0, 6040500.0, "EPSG:32630 (WGS 84 / UTM zone 30N)"),
        ("EPSG:27700", -2.752, 54.512, "EPSG:4326 (longitude and latitude)"),
        ("EPSG:4326", 54.512, -2.752, "with the two coordinates swapped"),
        ("EPSG:27700", 356139.0, 518875.0, "no system that is used at this site"),
    ],
)
def test_the_system_that_fits_is_named(crs, x, y, expected):
    message = refusal(crs, x, y)
    assert expected in message
    assert " km from the photographs" in message or "nowhere near" in message


def test_zones_of_the_datums_that_receivers_use_are_suggested_first():
    message = refusal("EPSG:32631", 514600.0, 6039000.0, (-2.7735, 54.5))
    first, second, *_ = re.findall(r"EPSG:(\d+) \(", message.partition("would fit in ")[2])
    assert {first, second} == {"25830", "32630"}
    assert "WGS 72" not in message


def test_coordinates_outside_of_the_domain_of_a_system_are_refused():
    assert "nowhere near the photographs" in refusal("EPSG:27700", 1e12, 1e12)


@pytest.mark.parametrize("text", ["EPSG:27700\n576640 5188050 183 1 2 DJI_0000.JPG A\n", "EPSG:32615\nhello\n", ""])
def test_control_that_does_not_fit_is_refused_if_it_was_asked_for_and_else_remarked(tmp_path: Path, text: str):
    survey_folder(tmp_path)
    (tmp_path / "gcp_list.txt").write_text(text)
    with pytest.raises(SurveyError):
        read_survey(tmp_path, control=tmp_path / "gcp_list.txt")
    survey = read_survey(tmp_path)
    assert survey.control is None
    (remark,) = survey.remarks
    assert "--no-control" in remark
    assert read_survey(tmp_path, find_control=False).remarks == ()


def test_control_is_at_the_site_of_photographs_on_both_sides_of_the_date_line(tmp_path: Path):
    for k, longitude in enumerate((179.9996, 179.9998, -179.9998, -179.9996)):
        photograph(tmp_path / f"{k}.jpg", table=exif(place=(-16.5, longitude)))
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:32701", always_xy=True).transform(-179.9997, -16.5)
    found, remarks = control(tmp_path, f"EPSG:32701\n{x} {y} 3 1 2 0.jpg A\n")
    assert list(found.points) == ["A"]
    assert remarks == []
    assert "longitude -179.99990" in refusal("EPSG:32701", x + 1e4, y, (180.0001, -16.5))


def test_control_at_one_end_of_a_long_beach_is_control_of_it(tmp_path):
    places = [(54.512 + 0.009 * k, -2.752) for k in range(9)]  # 8 km
    for k, place in enumerate(places):
        photograph(tmp_path / f"{k}.jpg", table=exif(place=place))
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:27700", always_xy=True).transform(-2.752, 54.512)
    found, _ = control(tmp_path, f"EPSG:27700\n{x:.3f} {y:.3f} 4.0 1 2 0.jpg A\n")
    assert list(found.points) == ["A"]
    with pytest.raises(SurveyError, match="km from the photographs"):
        control(tmp_path, f"EPSG:27700\n{x + 12_000:.3f} {y:.3f} 4.0 1 2 0.jpg A\n", "elsewhere.txt")

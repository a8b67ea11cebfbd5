"""Positions are read from tables of several programs and from geo.txt; the priority of two sources holds."""

import math
import os
import re
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from camera_files import BRIGHTON, exif, named, photograph, survey_folder
from pyproj import Transformer

from tidefield.errors import SurveyError
from tidefield.survey.io.photographs import read_survey
from tidefield.survey.io.positions import read_gps_file
from tidefield.survey.io.text_files import PhotographNames

NAMES = PhotographNames(["DJI_0001.JPG", "100MEDIA/DJI_0002.JPG", "Watt, Süd 3.jpeg"])


def whatever_grids_are_there(remarks: list[str]) -> list[str]:
    """Remarks without that on the grids of PROJ, which differ from machine to machine."""
    return [remark for remark in remarks if "PROJ lacks" not in remark]


def written(folder: Path, text: str, name: str = "gps.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize(
    "text",
    [
        "image_name,lat,lon,gps_height\nDJI_0001.JPG,54.5,-2.75,344.17\n",
        "\ufeffFilename;Longitude [deg];Latitude [deg];Altitude (m)\r\ndji_0001;-2,75;54,5;344,17\r\n",
        "#Label\tX/Longitude\tY/Latitude\tZ/Altitude\nDJI_0001.jpg\t-2.75\t54.5\t344.17\n",
        "z,y,x,name\n344.17,54.5,-2.75,C:\\flight\\DJI_0001.JPG\n",
        '# made by a receiver\nName,Latitude,Longitude,Elevation,Note\n"DJI_0001.DNG", 54.5, -2.75, 344.17, "a, b"\n\n',
    ],
)
def test_tables_of_several_programs_give_the_same_positions(tmp_path, text):
    found, _ = read_gps_file(written(tmp_path, text), NAMES)
    assert list(found) == ["DJI_0001.JPG"]
    position = found["DJI_0001.JPG"].position
    assert (position.latitude_deg, position.longitude_deg, position.height_m) == (54.5, -2.75, 344.17)
    assert (position.datum, position.source) == ("unknown", "gps.csv")
    assert math.isnan(position.horizontal_m)


def test_accuracies_of_a_table_are_read_and_empty_cells_are_unknown(tmp_path):
    text = (
        "Filename,Latitude,Longitude,Altitude,Accuracy Horizontal [m],Accuracy Vertical [m]\n"
        "DJI_0001,54.5,-2.75,,0.02,0\nDJI_0002,54.6,-2.75,300\nother.jpg,1,2,3,4,5\nWatt# Süd 3.jpeg,1,2,3,,\n"
        '"Watt, Süd 3.jpeg",,,1,,\n'
    )
    found, _ = read_gps_file(written(tmp_path, text), NAMES)
    first = found["DJI_0001.JPG"].position
    assert first.horizontal_m == 0.02
    assert math.isnan(first.height_m)
    assert math.isnan(first.vertical_m)
    assert found["100MEDIA/DJI_0002.JPG"].position.height_m == 300
    assert len(found) == 2


@pytest.mark.parametrize(
    ("title", "height_m"),
    [
        ("altitude (m)", 1000),
        ("Altitude [ft]", 304.8),
        ("Z/Altitude (feet above sea level)", 304.8),
        ("height (US survey feet)", 1200e3 / 3937),
        ("alt [usft]", 1200e3 / 3937),
        ("alt [ftUS]", 1200e3 / 3937),
        ("height (WGS84 ellipsoid)", 1000),
    ],
)
def test_heights_have_the_unit_in_the_title(tmp_path, title, height_m):
    text = f"name,Latitude [deg],lon,{title},accuracy vertical [mm]\nDJI_0001.JPG,54.5,-2.75,1000,20\n"
    position = read_gps_file(written(tmp_path, text), NAMES)[0]["DJI_0001.JPG"].position
    assert position.height_m == pytest.approx(height_m, rel=1e-12)
    assert (position.latitude_deg, position.vertical_m) == (54.5, pytest.approx(0.02))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("title", "height_m", "datum"),
    [
        ("alt_m", 1000, "unknown"),
        ("height_ft", 304.8, "unknown"),
        ("height_usft", 1200e3 / 3937, "unknown"),
        ("Ellipsoidal height", 1000, "ellipsoid"),
        ("ellipsoid height [m]", 1000, "ellipsoid"),
        ("altitude_ellipsoidal(m)", 1000, "ellipsoid"),
        ("h_ell_m", 1000, "ellipsoid"),
        ("Altitude above mean sea level (m)", 1000, "mean sea level"),
    ],
)
def test_units_and_zeros_of_heights_are_read_from_titles_without_brackets(tmp_path, title, height_m, datum):
    text = f"photo name;lat_deg;lon_deg;{title}\nDJI_0001.JPG;54.5;-2.75;1000\n"
    found, remarks = read_gps_file(written(tmp_path, text), NAMES)
    position = found["DJI_0001.JPG"].position
    assert position.height_m == pytest.approx(height_m, rel=1e-12)
    assert (position.datum, remarks) == (datum, [])


@pytest.mark.parametrize("title", ["geoid height", "height above ground", "Höhe"])
def test_columns_that_may_be_the_height_are_named_where_none_is_understood(tmp_path, title):
    text = f"name,lat,lon,note,{title},time\nDJI_0001.JPG,54.5,-2.75,1st,48.2,\nDJI_0002.JPG,54.5,-2.75,2nd,48.3,\n"
    found, (remark,) = read_gps_file(written(tmp_path, text), NAMES)
    assert math.isnan(found["DJI_0001.JPG"].position.height_m)
    assert f"its columns {title} are not read" in remark
    assert 'call it "height (m)"' in remark


@pytest.mark.parametrize(("vertical", "metre"), [("5703", 1), ("6360", 1200 / 3937), ("8228", 0.3048)])
def test_heights_of_a_geo_txt_have_the_unit_of_its_system(tmp_path, vertical, metre):
    text = f"EPSG:6340+{vertical}\nDJI_0001.JPG 500000 4200000 1000\n"
    position = read_gps_file(written(tmp_path, text, "geo.txt"), NAMES)[0]["DJI_0001.JPG"].position
    assert position.height_m == pytest.approx(1000 * metre, rel=1e-9)
    assert position.datum == "mean sea level"


@pytest.mark.parametrize("vertical", ["", "+5703", "+6360"])
def test_heights_of_a_system_in_feet_without_a_vertical_one_are_metres_with_a_remark(tmp_path, vertical):
    text = f"EPSG:2263{vertical}\nDJI_0001.JPG 1000000 200000 1000\n"
    found, remarks = read_gps_file(written(tmp_path, text, "geo.txt"), NAMES)
    metre = 1200 / 3937 if vertical == "+6360" else 1
    assert found["DJI_0001.JPG"].position.height_m == pytest.approx(1000 * metre, rel=1e-9)
    remarks = whatever_grids_are_there(remarks)
    assert len(remarks) == (vertical == "")
    assert all("US survey foot" in remark and "EPSG:2263+6360" in remark for remark in remarks)
    without = written(tmp_path, f"EPSG:2263{vertical}\nDJI_0001.JPG 1000000 200000\n", "geo.txt")
    assert whatever_grids_are_there(read_gps_file(without, NAMES)[1]) == []


@pytest.mark.parametrize("name", ["geo.txt", "gps.csv"])
@pytest.mark.parametrize("system", ["WGS 84", "EPSG:4326", "ETRS89"])
def test_a_table_may_name_the_system_of_its_degrees(tmp_path, name, system):
    text = f"{system}\nname,lat,lon,alt\nDJI_0001.JPG,54.5,-2.75,344\n"
    position = read_gps_file(written(tmp_path, text, name), NAMES)[0]["DJI_0001.JPG"].position
    assert (position.latitude_deg, position.longitude_deg, position.height_m) == (54.5, -2.75, 344)


@pytest.mark.parametrize("titles", ["name,lat,lon,alt", "name;lat;lon;alt", "name\tlat\tlon\talt"])
@pytest.mark.parametrize(
    ("system", "place", "datum"),
    [
        ("EPSG:4979", (54.5, -2.75), "ellipsoid"),
        ("EPSG:4326+5773", (54.5, -2.75), "mean sea level"),
        ("EPSG:4277", (54.500120761, -2.751418468), "unknown"),  # OSGB36, some 90 m off here
    ],
)
def test_degrees_and_heights_of_a_table_are_those_of_its_system(tmp_path, titles, system, place, datum):
    row = titles.replace("name", "DJI_0001.JPG").replace("lat", "54.5").replace("lon", "-2.75").replace("alt", "344")
    found, _ = read_gps_file(written(tmp_path, f"{system}\n{titles}\n{row}\n"), NAMES)
    position = found["DJI_0001.JPG"].position
    assert (position.latitude_deg, position.longitude_deg) == pytest.approx(place, abs=1e-8)
    assert (position.height_m, position.datum) == (344, datum)


@pytest.mark.parametrize("title", ["Survey", "Lisbon", "Tokyo", "2024"])
def test_a_title_above_a_table_is_no_system_though_proj_knows_one(tmp_path, title):
    text = f"{title}\nname,lat,lon,alt\nDJI_0001.JPG,54.5,-2.75,344\n"
    found, remarks = read_gps_file(written(tmp_path, text), NAMES)
    position = found["DJI_0001.JPG"].position
    assert (position.latitude_deg, position.longitude_deg, remarks) == (54.5, -2.75, [])


def test_a_system_above_a_table_is_named(tmp_path):
    text = "OSGB36\nname,lat,lon,alt\nDJI_0001.JPG,54.5,-2.75,344\n"
    assert whatever_grids_are_there(read_gps_file(written(tmp_path, text), NAMES)[1]) == [
        "gps.csv: positions are in OSGB36, as its first line has it."
    ]


def test_unit_and_datum_of_heights_in_a_title_go_before_those_of_the_system(tmp_path):
    for title, height_m, datum in (
        ("alt", 1000 * 1200 / 3937, "mean sea level"),
        ("alt [m]", 1000, "mean sea level"),
        ("ellipsoidal height (ft)", 304.8, "ellipsoid"),
    ):
        text = f"EPSG:4326+6360\nname,lat,lon,{title}\nDJI_0001.JPG,54.5,-2.75,1000\n"
        position = read_gps_file(written(tmp_path, text), NAMES)[0]["DJI_0001.JPG"].position
        assert position.height_m == pytest.approx(height_m, rel=1e-9), title
        assert position.datum == datum


@pytest.mark.parametrize(
    "titles",
    [
        "name\tlon\tlat\talt\tyaw\tpitch\troll\thacc\tvacc",
        "image_name\tx\ty\tz\tyaw (degrees)\tpitch (degrees)\troll (degrees)\thorz accuracy (m)\tvert accuracy (m)",
        "# name\tlon\tlat\talt\tyaw\tpitch\troll\thacc\tvacc",
    ],
)
def test_titles_change_nothing_of_a_geo_txt_in_tabs(tmp_path, titles):
    rows = "DJI_0001.JPG\t-2.75\t54.5\t344\t90\t5\t1\t0.02\t0.04\nDJI_0002.JPG\t-2.75\t54.5\t344\t0\t0\t0\t0.02\t0.04\n"
    bare, _ = read_gps_file(written(tmp_path, f"EPSG:4979\n{rows}", "geo.txt"), NAMES)
    titled, _ = read_gps_file(written(tmp_path, f"EPSG:4979\n{titles}\n{rows}", "geo.txt"), NAMES)
    assert titled == bare
    assert titled["DJI_0001.JPG"].gimbal_deg == pytest.approx((78.675, -84.901, 11.281), abs=1e-3)
    assert titled["100MEDIA/DJI_0002.JPG"].gimbal_deg is None


@pytest.mark.parametrize("system", ["", "EPSG:4326\n"])
def test_angles_of_other_tables_are_not_read(tmp_path, system):
    text = f"{system}name,lat,lon,alt,yaw,pitch,roll\nDJI_0001.JPG,54.5,-2.75,344,90,-90,\n"
    found, _ = read_gps_file(written(tmp_path, text), NAMES)
    assert found["DJI_0001.JPG"].gimbal_deg is None


@pytest.mark.parametrize(
    "rows", ["EPSG:4326\nDJI_0001.JPG -2.75 54.5\n", "name,lat,lon,alt\nDJI_0001.JPG,54.5,-2.75,\n"]
)
def test_a_line_may_be_there_twice(tmp_path, rows):
    found, _ = read_gps_file(written(tmp_path, rows + rows.splitlines()[1], "geo.txt"), NAMES)
    assert list(found) == ["DJI_0001.JPG"]


@pytest.mark.parametrize("titles", ["name,x,y,z", "name,easting,northing,height"])
def test_a_table_in_metres_is_to_be_separated_as_a_geo_txt_is(tmp_path, titles):
    text = f"EPSG:32630\n{titles}\nDJI_0001.JPG,530000,5600000,40\n"
    with pytest.raises(SurveyError, match=r"names none of the photographs: .*in rows separated by spaces or tabs"):
        read_gps_file(written(tmp_path, text), NAMES)


@pytest.mark.parametrize("name", ["geo.txt", "positions.csv"])
@pytest.mark.parametrize("titles", ["#image\tx\ty\tz", "# image,lat,lon,z"])
def test_titles_below_the_system_of_a_geo_txt_are_a_comment(tmp_path, name, titles):
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:32630", always_xy=True).transform(-2.75, 54.5)
    text = f"EPSG:32630\n{titles}\nDJI_0001.JPG\t{x}\t{y}\t344.17\n"
    position = read_gps_file(written(tmp_path, text, name), NAMES)[0]["DJI_0001.JPG"].position
    assert (position.latitude_deg, position.longitude_deg) == pytest.approx((54.5, -2.75), abs=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "begins with 'nothing': expected a header such as image_name,lat,lon,gps_height"),
        ("DJI_0001,54.5,-2.75\n", "begins with 'DJI_0001,54.5,-2.75': expected a header"),
        ("name,lat,lon\nDJI_0001,54.5,west\n", "line 2 has 'west': expected a number"),
        ("name,lat,lon\nDJI_0001,512875.75,351139.75\n", "line 2 gives .* metres belong under the EPSG code"),
        ("name,lat,lon\nDJI_0001,54.5,2\nDJI_0001,54.6,2\n", "line 3 gives DJI_0001.JPG a second position"),
        ("name,lat,lon\nIMG_1,54.5,2\n", "names none of the photographs"),
    ],
)
def test_a_table_that_cannot_be_understood_is_an_error(tmp_path, text, message):
    with pytest.raises(SurveyError, match=message):
        read_gps_file(written(tmp_path, text), NAMES)


def test_a_table_in_another_encoding_is_an_error(tmp_path):
    (tmp_path / "gps.csv").write_bytes("name,lat,lon\nSüd.jpg,54.5,2\n".encode("latin-1"))
    with pytest.raises(SurveyError, match=r"gps.csv is not in UTF-8"):
        read_gps_file(tmp_path / "gps.csv", NAMES)
    with pytest.raises(SurveyError, match=r"none.csv cannot be read"):
        read_gps_file(tmp_path / "none.csv", NAMES)


def test_a_short_name_of_two_photographs_is_an_error(tmp_path):
    names = PhotographNames(["100MEDIA/DJI_0001.JPG", "101MEDIA/DJI_0001.JPG"])
    path = written(tmp_path, "name,lat,lon\nDJI_0001.JPG,54.5,2\n")
    with pytest.raises(SurveyError, match=r"DJI_0001.JPG names 2 photographs .*write its folder, too"):
        read_gps_file(path, names)
    found, _ = read_gps_file(written(tmp_path, "name,lat,lon\n101media\\DJI_0001.JPG,54.5,2\n"), names)
    assert list(found) == ["101MEDIA/DJI_0001.JPG"]


@pytest.mark.parametrize(
    ("header", "datum"),
    [
        ("EPSG:32630", "unknown"),
        ("WGS84 UTM 30N", "unknown"),
        ("+proj=utm +zone=30 +datum=WGS84 +units=m +no_defs", "unknown"),
        ("EPSG:32630+5773", "mean sea level"),
    ],
)
def test_a_geo_txt_in_metres_becomes_degrees(tmp_path, header, datum):
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:32630", always_xy=True).transform(-2.75, 54.5)
    text = f"# of the office\n{header}\nDJI_0001.JPG {x} {y} 344.17\nWatt, Süd 3.jpeg {x} {y}\nother.jpg 1 2 3\n"
    found, _ = read_gps_file(written(tmp_path, text, "geo.txt"), NAMES)
    assert list(found) == ["DJI_0001.JPG", "Watt, Süd 3.jpeg"]
    position = found["DJI_0001.JPG"].position
    assert (position.latitude_deg, position.longitude_deg) == pytest.approx((54.5, -2.75), abs=1e-9)
    assert (position.height_m, position.datum, position.source) == (344.17, datum, "geo.txt")
    assert math.isnan(found["Watt, Süd 3.jpeg"].position.height_m)


def test_angles_and_accuracies_of_a_geo_txt_are_read(tmp_path):
    text = (
        "EPSG:4326\nDJI_0001.JPG -2.75 54.5 344 90 5 1 0.02 0.04 extra\n"
        "DJI_0002 -2.75 54.5 344 0 0 0 0.02 0.04\nWatt, Süd 3.jpeg\t-2.75\t54.5\tNaN\n"
    )
    found, _ = read_gps_file(written(tmp_path, text, "geo.txt"), NAMES)
    first, second = found["DJI_0001.JPG"], found["100MEDIA/DJI_0002.JPG"]
    assert first.gimbal_deg == pytest.approx((78.675, -84.901, 11.281), abs=1e-3)
    assert (first.position.horizontal_m, first.position.vertical_m) == (0.02, 0.04)
    assert second.gimbal_deg is None  # three zeros stand for angles that are not available
    assert math.isnan(found["Watt, Süd 3.jpeg"].position.height_m)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the first line of .*geo.txt is '': expected a projected or geographic coordinate reference system"),
        ("DJI_0001.JPG -2.75 54.5\n", "is 'DJI_0001.JPG -2.75 54.5': expected a projected or geographic"),
        ("EPSG:4978\nDJI_0001.JPG 1 2 3\n", "is 'EPSG:4978': expected a projected or geographic"),
        ("EPSG:4326\nDJI_0001.JPG here there\n", "line 2 is 'DJI_0001.JPG here there': expected image_name x y"),
        ("EPSG:27700\nDJI_0001.JPG 1e12 1e12 3\n", "line 2 gives .*: expected coordinates in 'EPSG:27700'"),
        ("EPSG:4326\nIMG_1.JPG 1 2 3\n", "names none of the photographs"),
    ],
)
def test_a_geo_txt_that_cannot_be_understood_is_an_error(tmp_path, text, message):
    with pytest.raises(SurveyError, match=message):
        read_gps_file(written(tmp_path, text, "geo.txt"), NAMES)


def test_a_file_in_the_folder_gives_positions_that_exif_lacks(tmp_path):
    survey_folder(tmp_path, count=3)
    photograph(tmp_path / "x.jpg")
    written(tmp_path, f"name,lat,lon\nDJI_0000,46.9,-91.9\nx,{BRIGHTON[0]},{BRIGHTON[1]}\n", "GPS.CSV")
    survey = read_survey(tmp_path)
    sources = [photograph.position and photograph.position.source for photograph in survey.photographs]
    assert sources == ["EXIF", "EXIF", "EXIF", "GPS.CSV"]
    assert survey.remarks == ()


def test_a_file_that_is_given_has_priority_over_exif(tmp_path):
    survey_folder(tmp_path / "photographs", count=4)
    path = written(tmp_path, "EPSG:4326\nDJI_0000.JPG -91.99 46.84 200 10 0 0\n", "better.txt")
    survey = read_survey(tmp_path / "photographs", gps=path)
    first, second = survey.photographs[:2]
    assert first.position is not None
    assert (first.position.source, first.position.longitude_deg) == ("better.txt", -91.99)
    assert first.gimbal_deg == (10, -90, 0)
    assert second.position is not None
    assert second.position.source == "EXIF"
    with pytest.raises(SurveyError, match=r"nowhere.csv cannot be read"):
        read_survey(tmp_path / "photographs", gps=tmp_path / "nowhere.csv")


def test_photographs_that_a_given_file_does_not_name_are_remarked(tmp_path):
    survey_folder(tmp_path / "photographs", count=4)
    path = written(tmp_path, "name,lat,lon,height\nDJI_0000,46.8426,-91.9946,200\nDJI_0002,46.8428,-91.9946,200\n")
    survey = read_survey(tmp_path / "photographs", gps=path)
    assert survey.remarks == (
        "gps.csv has 2 of 4 photographs; 2 others keep the positions of EXIF (DJI_0001.JPG, DJI_0003.JPG).",
    )


def test_a_file_without_heights_leaves_those_of_exif(tmp_path):
    survey_folder(tmp_path / "photographs", count=3)
    path = written(tmp_path, "name,lat,lon\n" + "".join(f"DJI_000{k},46.84{k},-91.9,\n" for k in range(3)))
    for read in read_survey(tmp_path / "photographs", gps=path).photographs:
        position = read.position
        assert position is not None
        assert (position.longitude_deg, position.height_m, position.datum) == (-91.9, 200, "mean sea level")
        assert position.source == "EXIF, gps.csv"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("gps.csv", "time,speed\n1,2\n"),
        ("gps.csv", "name,lat,lon\nx,54.5,west\n"),
        ("geo.txt", "EPSG:4326\nother.jpg 1 2 3\n"),
        ("geo.txt", "notes of the flight\n"),
    ],
)
def test_a_file_in_the_folder_that_is_none_of_positions_is_remarked_and_refused_if_it_is_given(tmp_path, name, text):
    photograph(survey_folder(tmp_path, count=3) / "x.jpg")
    path = written(tmp_path, text, name)
    survey = read_survey(tmp_path)
    assert [p.position is not None for p in survey.photographs] == [True] * 3 + [False]
    assert survey.remarks[0].startswith("The file of positions next to the photographs was not used: ")
    assert name in survey.remarks[0]
    assert "rename it or move it away" in survey.remarks[0]
    with pytest.raises(SurveyError):
        read_survey(tmp_path, gps=path)


def test_a_file_in_the_folder_that_contradicts_itself_is_refused(tmp_path):
    photograph(survey_folder(tmp_path, count=3) / "x.jpg")
    written(tmp_path, "name,lat,lon\nx,54.5,2\nx,54.6,2\n")
    with pytest.raises(SurveyError, match=r"line 3 gives x.jpg a second position"):
        read_survey(tmp_path)


def moved(folder: Path, **places: tuple[float, float]) -> Path:
    """Six photographs close together, and some elsewhere."""
    survey_folder(folder, count=6)
    for name, place in places.items():
        photograph(folder / f"{name}.jpg", table=exif(place=place))
    return folder


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ((0.0, 0.0), "it is zero: the receiver had no fix"),
        ((-91.9946, 46.8426), "its latitude is beyond the poles: latitude and longitude are swapped"),
        ((46.8426, -300.0), "it is outside of the range of coordinates"),
        ((47.74, -91.9946), "it is 100 km from the others"),
    ],
)
def test_an_impossible_position_is_left_out_and_reported(tmp_path, place, reason):
    survey = read_survey(moved(tmp_path, odd=place))
    assert named(survey, "odd.jpg").position is None
    assert sum(photograph.position is not None for photograph in survey.photographs) == 6
    remark = next(remark for remark in survey.remarks if remark.startswith("The position of odd.jpg"))
    assert reason in remark
    assert any(remark.startswith("1 of 7 photographs have no position: odd.jpg") for remark in survey.remarks)


def test_swapped_latitude_and_longitude_are_found_by_the_other_positions(tmp_path):
    for index in range(5):
        photograph(tmp_path / f"{index}.jpg", table=exif(place=(45.03, 7.62 + 1e-4 * index)))
    photograph(tmp_path / "odd.jpg", table=exif(place=(7.62, 45.03)))
    survey = read_survey(tmp_path)
    assert named(survey, "odd.jpg").position is None
    assert re.search("odd.jpg.* km from the others: latitude and longitude are swapped", survey.remarks[0])


def test_a_file_helps_where_exif_is_impossible(tmp_path):
    written(moved(tmp_path, odd=(0.0, 0.0)), f"name,lat,lon\nodd,{BRIGHTON[0]},{BRIGHTON[1]}\n")
    odd = named(read_survey(tmp_path), "odd.jpg")
    assert odd.position is not None
    assert odd.position.source == "gps.csv"


def test_two_sites_keep_their_positions_and_are_reported(tmp_path):
    elsewhere = {f"x{index}": (47.74, -91.99 + 1e-4 * index) for index in range(4)}
    survey = read_survey(moved(tmp_path, **elsewhere))
    assert all(photograph.position for photograph in survey.photographs)
    assert "4 of the 10 positions lie 100 km and more from the others (x0.jpg" in survey.remarks[0]
    assert "two sites" in survey.remarks[0]


def test_a_survey_on_the_date_line_is_one_site(tmp_path):
    for index, longitude in enumerate((179.9995, 179.9998, -179.9999, -179.9996)):
        photograph(tmp_path / f"{index}.jpg", table=exif(place=(-16.5, longitude)))
    survey = read_survey(tmp_path)
    assert survey.remarks == ()
    assert all(photograph.position for photograph in survey.photographs)


def test_a_stray_quotation_mark_is_an_error_with_its_line(tmp_path):
    rows = "".join(f"{k}.jpg,54.5,-2.75,1\n" for k in range(9000))
    text = f'name,lat,lon,height\nDJI_0001.JPG,54.5,-2.75,1\n"{rows}'
    with pytest.raises(SurveyError, match=r"gps.csv, line 3 cannot be read .*: expected quotation marks in pairs"):
        read_gps_file(written(tmp_path, text), NAMES)


@pytest.mark.parametrize("crs", ["EPSG:32600", "EPSG:32700", "WGS84 UTM 0N", "IAU_2015:30100"])
def test_a_system_without_a_way_to_wgs_84_is_refused(tmp_path, crs):
    with pytest.raises(SurveyError, match="expected a projected or geographic coordinate reference system"):
        read_gps_file(written(tmp_path, f"{crs}\nDJI_0001.JPG 500000 5000000 1\n", "geo.txt"), NAMES)


def test_long_lines_take_no_longer_than_their_length(tmp_path):
    text = "EPSG:4326\n" + "word " * 200_000 + "\nDJI_0001.JPG -2.75 54.5 1\n" + "name [" + "[" * 1_000_000
    start = time.process_time()
    assert list(read_gps_file(written(tmp_path, text, "geo.txt"), NAMES)[0]) == ["DJI_0001.JPG"]
    assert time.process_time() - start < 2


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")
def test_positions_come_from_regular_files_only(tmp_path):
    os.mkfifo(tmp_path / "gps.csv")
    for path in (tmp_path / "gps.csv", Path("/dev/zero")):
        with pytest.raises(SurveyError, match="is no regular file"):
            read_gps_file(path, NAMES)


def test_the_folder_in_a_path_of_another_machine_distinguishes_names():
    names = PhotographNames(["100MEDIA/DJI_0001.JPG", "101MEDIA/DJI_0001.JPG", "DJI_0003.JPG"])
    for path in ("/data/photos/100MEDIA/DJI_0001.JPG", "photos/100MEDIA/dji_0001", "C:\\f\\100MEDIA\\DJI_0001.JPG"):
        assert names.find(path) == "100MEDIA/DJI_0001.JPG"
    assert names.find("/elsewhere/DJI_0003.JPG") == "DJI_0003.JPG"
    with pytest.raises(SurveyError, match=r"names 2 photographs .*write its folder, too"):
        names.find("/elsewhere/DJI_0001.JPG")
    later = PhotographNames(["100MEDIA/DJI_0001.JPG", "100MEDIA/DJI_0002.JPG"])
    assert later.find("101MEDIA/DJI_0001.JPG") is None, "cameras number photographs anew in each folder"
    for path in ("DJI_0001.JPG", "D:\\x\\100MEDIA\\DJI_0001.DNG", "/flight/DJI_0001.JPG"):
        assert later.find(path) == "100MEDIA/DJI_0001.JPG"
    inner = PhotographNames(["DCIM/100MEDIA/DJI_0001.JPG"])
    assert inner.find("100MEDIA/DJI_0001.JPG") == "DCIM/100MEDIA/DJI_0001.JPG"
    assert inner.find("DCIM/101MEDIA/DJI_0001.JPG") is None


def test_letters_of_the_hemispheres_beside_unsigned_degrees_are_signs(tmp_path):
    text = "SourceFile,GPSLatitude,GPSLatitudeRef,GPSLongitude,GPSLongitudeRef\nDJI_0001.JPG,33.9,South,58.4,W\n"
    found, remarks = read_gps_file(written(tmp_path, text), NAMES)
    position = found["DJI_0001.JPG"].position
    assert (position.latitude_deg, position.longitude_deg) == (-33.9, pytest.approx(-58.4))
    assert not any("Ref" in remark for remark in remarks)


@pytest.mark.parametrize(
    ("titles", "south"),
    [
        ("lat,lat_ref,lon,lon_ref", "S"),
        ("latitude,N/S,longitude,E/W", "s"),
        ("lat,NS,lon,EW", "South"),
        ("Lat,hemisphere,Long,side", "S"),
    ],
)
def test_hemispheres_are_known_by_what_is_in_their_columns(tmp_path, titles, south):
    text = f"image,{titles}\nDJI_0001.JPG,41.47,{south},72.94,W\nDJI_0002.JPG,41.47,,72.95,E\n"
    found, remarks = read_gps_file(written(tmp_path, text), NAMES)
    places = [(r.position.latitude_deg, r.position.longitude_deg) for r in found.values()]
    assert places == [(-41.47, pytest.approx(-72.94)), (41.47, 72.95)]
    assert remarks == []


def test_one_column_of_a_hemispheres_letter_is_none(tmp_path):
    text = "image,lat,lon,fix\nDJI_0001.JPG,54.1,8.2,S\nDJI_0002.JPG,54.1,8.3,S\n"
    found, _ = read_gps_file(written(tmp_path, text), NAMES)
    assert {record.position.latitude_deg for record in found.values()} == {54.1}


def test_a_column_of_other_words_is_no_hemisphere(tmp_path):
    text = "image,lat,lon,wind,line\nDJI_0001.JPG,41.47,72.94,W,S\nDJI_0002.JPG,41.47,72.95,SW,3\n"
    found, _ = read_gps_file(written(tmp_path, text), NAMES)
    assert {record.position.latitude_deg for record in found.values()} == {41.47}
    assert {record.position.longitude_deg for record in found.values()} == {72.94, 72.95}


@pytest.mark.parametrize("titles", ["x,y,z,latitude,longitude,altitude", "X [m],Y [m],Z [m],lat_deg,lon_deg,alt_m"])
def test_coordinates_of_a_grid_do_not_hide_latitude_and_longitude(tmp_path, titles):
    text = f"image,{titles}\nDJI_0001.JPG,673456.1,5412345.2,3,-41.47,-72.94,12\n"
    position = read_gps_file(written(tmp_path, text), NAMES)[0]["DJI_0001.JPG"].position
    assert (position.latitude_deg, position.longitude_deg, position.height_m) == (-41.47, -72.94, 12)


def test_longitudes_that_count_to_360_are_those_of_the_west(tmp_path):
    found, _ = read_gps_file(written(tmp_path, "name,lat,lon,height\nDJI_0001.JPG,40.0,285.0,10\n"), NAMES)
    assert found["DJI_0001.JPG"].position.longitude_deg == pytest.approx(-75.0)


def test_positions_that_proj_converts_to_metres_only_are_remarked(tmp_path, monkeypatch):
    class Group:
        best_available = False
        transformers = (SimpleNamespace(accuracy=2.0),)
        unavailable_operations = (
            SimpleNamespace(
                accuracy=0.05, grids=[SimpleNamespace(short_name="grid.tif", full_name="", available=False)]
            ),
        )

    monkeypatch.setattr("tidefield.geometry.geodesy.TransformerGroup", lambda *_, **__: Group())
    text = "EPSG:27700\nDJI_0001.JPG 351139.7 512875.7 264.3\n"
    _, remarks = read_gps_file(written(tmp_path, text, "geo.txt"), NAMES)
    assert any("converted to WGS 84 to 2 m only, because PROJ lacks grid.tif: install it" in r for r in remarks)
    monkeypatch.setattr(Group, "best_available", True)
    _, remarks = read_gps_file(written(tmp_path, text, "geo.txt"), NAMES)
    assert not any("PROJ lacks" in r for r in remarks)


def test_a_file_of_positions_that_is_not_used_is_named(tmp_path):
    for index in range(4):
        photograph(tmp_path / f"{index}.jpg", table=exif(place=(54.5, -2.75 + 1e-4 * index)))
    (tmp_path / "geo.txt").write_text("EPSG:4326\n0.jpg -2.75 54.5 10\n")
    survey = read_survey(tmp_path)
    assert any("geo.txt is not used, because all photographs have positions" in remark for remark in survey.remarks)


@pytest.mark.parametrize(
    ("titles", "unread"),
    [
        ("Accuracy Horz [m],Accuracy Vert [m]", False),
        ("Lateral RMS,Elevation RMS", False),
        ("StdE (m),StdU (m)", True),
    ],
)
def test_accuracies_are_read_by_the_titles_of_receivers_or_named(tmp_path, titles, unread):
    text = f"Name,Latitude,Longitude,Ellipsoidal height,{titles}\nDJI_0001.JPG,54.5,-2.75,344.17,0.02,0.03\n"
    found, remarks = read_gps_file(written(tmp_path, text), NAMES)
    position = found["DJI_0001.JPG"].position
    if unread:
        assert any("gps.csv: StdE (m), StdU (m) are not read." in remark for remark in remarks)
    else:
        assert (position.horizontal_m, position.vertical_m) == (0.02, 0.03)
        assert not any("not read" in remark for remark in remarks)

"""M3C2 against CloudCompare's table, brute force and planes."""

import numpy as np
import pytest
from shared_data import SHARED

from tidefield.change.m3c2 import fit_normals, m3c2

BMX = SHARED / "change" / "bmx"


def test_cloudcompares_table_is_reproduced():
    """103 core points of PDAL's autzen-bmx pair; the table has three decimals."""
    if not BMX.is_dir():
        pytest.skip(f"needs {BMX}")
    from tidefield.change.clouds import read_cloud

    table = np.genfromtxt(BMX / "autzen-bmx-cc.txt", delimiter=",", names=True)
    columns = [np.asarray(table[name]) for name in table.dtype.names]
    cores, normals = np.stack(columns[:3], axis=1), np.stack(columns[-3:], axis=1)
    clouds = []
    for year in (2010, 2023):
        import laspy

        las = laspy.read(BMX / f"autzen-bmx-{year}.las")
        clouds.append(np.asarray(las.xyz, np.float64))
        assert len(read_cloud(BMX / f"autzen-bmx-{year}.las").xyz) > 500
    found = m3c2(*clouds, cores, normals, 2.890432, 5.5)
    assert len(cores) == 103
    assert np.array_equal(found.counts[:, 0], table["Npoints_cloud1"])
    assert np.array_equal(found.counts[:, 1], table["Npoints_cloud2"])
    assert np.array_equal(np.isnan(found.distance_m), np.isnan(table["M3C2_distance"]))
    assert np.nanmax(np.abs(found.distance_m - table["M3C2_distance"])) < 0.002
    known = np.isfinite(found.detection_m) & np.isfinite(table["distance_uncertainty"])
    assert known.sum() == 95
    assert np.abs(found.detection_m - table["distance_uncertainty"])[known].max() < 0.001
    fitted = fit_normals(clouds[0], cores, 1.390432)
    angles = np.abs((fitted * normals).sum(axis=1))
    assert np.median(angles) > 0.99


def test_planes_are_as_far_apart_as_they_are():
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 20, (20_000, 2))
    normal = np.array([0.2, -0.1, 1]) / np.linalg.norm([0.2, -0.1, 1])
    plane = np.column_stack([xy, -(xy @ normal[:2]) / normal[2]])
    later = plane + 0.07 * normal + rng.normal(0, 0.01, plane.shape)
    cores = plane[(np.abs(xy - 10) < 6).all(axis=1)][::50]
    normals = fit_normals(plane, cores, 1.0)
    assert np.abs(normals @ normal - 1).max() < 1e-9
    found = m3c2(plane, later, cores, normals, 1.0, 2.0)
    assert np.abs(found.distance_m - 0.07).max() < 0.01
    assert found.significant.all()


def test_a_cylinder_without_points_has_no_distance():
    cloud = np.random.default_rng(0).uniform(0, 1, (100, 3))
    found = m3c2(cloud, cloud + 50, np.array([[0.5, 0.5, 0.5]]), np.array([[0.0, 0.0, 1.0]]), 0.5, 1.0)
    assert found.counts[0, 1] == 0
    assert np.isnan(found.distance_m[0])
    assert not found.significant[0]


def test_a_mean_is_not_believed_beyond_the_points_own_errors():
    cloud = np.column_stack([np.random.default_rng(0).uniform(0, 1, (100, 2)), np.zeros(100)])
    core, up = np.array([[0.5, 0.5, 0.0]]), np.array([[0.0, 0.0, 1.0]])
    plain = m3c2(cloud, cloud, core, up, 1.0, 1.0)
    careful = m3c2(cloud, cloud, core, up, 1.0, 1.0, sigmas=(np.full(100, 0.1), np.full(100, 0.1)))
    assert plain.detection_m[0] == 0
    assert careful.detection_m[0] == pytest.approx(1.96 * 0.1 * np.sqrt(2 / 100))

"""Exposure gains: planted gains are recovered, and held-out pixels have no influence."""

import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from shared_data import SHARED
from torch import Tensor

from tidefield.data import exposure
from tidefield.data.exif import Exposures, read_exposures
from tidefield.data.exposure import estimate_gains, observe
from tidefield.data.images import Photographs
from tidefield.data.readers.posed import every_eighth
from tidefield.data.scene import SparsePoints
from tidefield.geometry.cameras import Cameras

COUNT, WIDTH, HEIGHT, FOCAL, HEIGHT_M = 17, 96, 72, 80.0, 40.0
TRAIN, TEST = every_eighth(COUNT)


class Watched(Photographs):
    """Photographs that record which of them were read."""

    asked: ClassVar[list[int]] = []

    def __getitem__(self, index: int) -> Tensor:
        self.asked.append(index)
        return super().__getitem__(index)


def ground(xy: Tensor) -> Tensor:
    """A smooth, colourful ground: values in 40..120 at gain 1."""
    phase = torch.tensor([0.0, 1.0, 2.0])
    return 80 + 20 * torch.sin(xy[..., :1] * 0.11 + phase) + 20 * torch.cos(xy[..., 1:] * 0.13 + phase)


def survey(gain: Tensor) -> tuple[Watched, Cameras, SparsePoints]:
    """A nadir strip, one photograph every 6 m, of the smooth ground, each times its gain."""
    position = torch.stack([torch.arange(COUNT) * 6.0, torch.zeros(COUNT), torch.full((COUNT,), HEIGHT_M)], 1)
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0])).expand(COUNT, 3, 3)
    cameras = Cameras(
        T_world_camera=torch.cat([down, position[:, :, None]], 2),
        focal_px=torch.full((COUNT, 2), FOCAL),
        principal_px=torch.tensor([WIDTH / 2, HEIGHT / 2]).expand(COUNT, 2),
        size_px=torch.tensor([WIDTH, HEIGHT]).expand(COUNT, 2),
        near_far=torch.tensor([30.0, 50.0]).expand(COUNT, 2),
        gain=torch.ones(COUNT, 3),
    )
    v, u = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    offset = torch.stack([u - WIDTH / 2, HEIGHT / 2 - v], -1) * HEIGHT_M / FOCAL
    pixels = [(ground(p[:2] + offset) * g).round().clamp(0, 255).byte() for p, g in zip(position, gain, strict=True)]
    generator = torch.Generator().manual_seed(3)
    low, high = torch.tensor([-20.0, -15.0]), torch.tensor([116.0, 15.0])
    xy = low + (high - low) * torch.rand(900, 2, generator=generator)
    xyz = torch.cat([xy, torch.zeros(900, 1)], 1)
    uv, _ = cameras.project(xyz)
    inside = ((uv > 3) & (uv < torch.tensor([WIDTH - 3.0, HEIGHT - 3.0]))).all(-1)
    camera, point = inside.nonzero(as_tuple=True)
    return Watched(tuple(pixels)), cameras, SparsePoints(xyz, torch.ones(900), point, camera, uv[inside])


def gains(
    photographs: Photographs,
    cameras: Cameras,
    points: SparsePoints | None,
    train: tuple[int, ...],
    metadata: Exposures | None = None,
    divided_by: np.ndarray | None = None,
) -> Tensor:
    seen = None if points is None else observe(photographs, cameras, points, train)
    return estimate_gains(seen, cameras, train, metadata, divided_by)[0]


def planted(spread: float = 0.25) -> Tensor:
    """Gains that wander along the flight, channels apart."""
    step = torch.arange(COUNT)[:, None] * 0.5 + torch.tensor([0.0, 0.4, 0.9])
    return torch.exp(spread * torch.sin(step))


def relative(gain: Tensor) -> Tensor:
    return gain / gain[list(TRAIN)].log().mean(0).exp()


def test_planted_gains_are_recovered_within_one_percent():
    truth = planted()
    photographs, cameras, points = survey(truth)
    found = gains(photographs, cameras, points, TRAIN)
    error = (found / relative(truth)).log().abs()
    assert error[list(TRAIN)].max() < 0.01
    assert found[list(TRAIN)].log().mean(0).abs().max() < 1e-5


def disagreement(photographs: Photographs, cameras: Cameras, points: SparsePoints, gains: torch.Tensor) -> float:
    """Root-mean-square of what is left of the logarithms of the training photographs' colours of shared points."""
    seen = observe(photographs, cameras, points, TRAIN)
    residual = seen.centred(seen.value - np.log(gains.double().numpy())[seen.photograph])
    return float(np.sqrt((residual**2).mean()))


def test_gains_remove_the_disagreement_of_photographs():
    photographs, cameras, points = survey(planted())
    before = disagreement(photographs, cameras, points, torch.ones(COUNT, 3))
    after = disagreement(photographs, cameras, points, gains(photographs, cameras, points, TRAIN))
    assert before > 0.1
    assert after < 0.01


def flight(strips: int, each: int, seed: int) -> tuple[exposure.Seen, np.ndarray, np.ndarray]:
    """What photographs show that fly to and fro, where the side towards the sun is brighter in each of them, light
    changes now and then, and a lens is brighter on one side; their positions, and true log gains."""
    random = np.random.default_rng(seed)
    east = np.concatenate([np.arange(each)[:: 1 - 2 * (strip % 2)] for strip in range(strips)]) * 0.25
    position = np.stack([east, np.repeat(np.arange(strips), each) * 0.35, np.ones(strips * each)], 1)
    ground = np.stack([random.uniform(-0.4, side.max() + 0.4, 10 * len(position)) for side in position[:, :2].T], 1)
    ground = np.pad(ground, ((0, 0), (0, 1)))
    ray = ground[None] - position[:, None]
    photograph, point = np.nonzero((np.abs(ray[..., :2]) < (0.5, 0.4)).all(-1))
    ray = ray[photograph, point]
    direction = (ray / np.linalg.norm(ray, axis=1, keepdims=True))[:, :2]
    light = np.cumsum(np.where(random.random(len(position)) < 0.03, random.normal(0, 0.3, len(position)), 0))
    heading = np.repeat(1 - 2 * (np.arange(strips) % 2), each)
    value = random.normal(0, 0.3, len(ground))[point] + light[photograph] + direction @ SUN
    value += 0.02 * heading[photograph] * ray[:, 0] + random.normal(0, 0.03, len(point))
    seen = exposure.Seen(np.repeat(value[:, None], 3, 1), point, photograph, np.arange(len(point)), direction)
    return seen.part(np.bincount(point)[point] > 1), position, light


SUN = np.array([0.3, -0.1])


def test_ways_of_looking_do_not_add_up_along_a_strip():
    """The side towards the sun is brighter in every photograph of a long strip, and light changes now and then."""
    count, each, random = 400, 60, np.random.default_rng(7)
    photograph = np.repeat(np.arange(count), each)
    point = (photograph * 20 + random.integers(0, 100, count * each)).astype(np.int64)
    ahead = point / 20 - photograph - 2.5  # of -2.5 to 2.5 photographs
    truth = 0.2 * np.sin(np.arange(count))
    albedo = random.normal(0, 0.3, point.max() + 1)
    value = (albedo[point] + truth[photograph] + 0.01 * ahead + random.normal(0, 0.01, len(point)))[:, None]
    direction = np.stack([0.25 * ahead, np.zeros(len(ahead))], 1)
    seen = exposure.Seen(np.repeat(value, 3, 1), point, photograph, np.arange(len(point)), direction)
    position = np.stack([np.arange(count), np.zeros(count), np.zeros(count)], 1).astype(np.float64)
    order = np.arange(count)
    error = exposure._solve(seen, np.zeros(count), order.astype(np.float64), position, order)[0][:, 0] - truth
    slope = np.polyfit(order, error, 1)[0]
    assert abs(slope) < 0.01 / 20
    assert np.sqrt((np.diff(error) ** 2).mean()) < 0.01
    alone = exposure.robust_gains(seen, np.zeros(count))[0][:, 0] - truth
    assert abs(np.polyfit(order, alone, 1)[0]) > 0.01 / 2  # what the overlaps say


def test_ways_of_looking_do_not_add_up_in_flights_to_and_fro():
    seen, position, truth = flight(8, 25, 7)
    order = np.arange(len(truth))
    found, sun = exposure._solve(seen, np.zeros(len(truth)), order.astype(np.float64), position, order)
    error = found[:, 0] - found[:, 0].mean() - truth + truth.mean()
    assert np.abs(error).max() < 0.05
    assert np.sqrt((np.diff(error) ** 2).mean()) < 0.01
    np.testing.assert_allclose(sun[:, 0], SUN, atol=0.02)
    unknown = replace(seen, direction=np.zeros_like(seen.direction))
    alone = exposure._solve(unknown, np.zeros(len(truth)), order.astype(np.float64), position, order)[0][:, 0]
    assert np.ptp(alone - truth) > 1  # what the overlaps say


def test_a_held_out_photograph_is_predicted_by_its_neighbours():
    truth = planted()
    photographs, cameras, points = survey(truth)
    found = gains(photographs, cameras, points, TRAIN)
    inner = [i for i in TEST if 0 < i < COUNT - 1]
    assert (found / relative(truth)).log()[inner].abs().max() < 0.05
    assert relative(truth).log()[inner].abs().max() > 0.1


def test_pixels_of_held_out_photographs_change_no_gain():
    photographs, cameras, points = survey(planted())
    before = gains(photographs, cameras, points, TRAIN)
    for i in TEST:
        photographs.colours[i].neg_()  # modulo 256
    photographs.asked.clear()
    assert torch.equal(gains(photographs, cameras, points, TRAIN), before)
    assert not set(photographs.asked) & set(TEST)


def test_outliers_like_moving_water_are_tolerated():
    truth = planted()
    photographs, cameras, points = survey(truth)
    generator = torch.Generator().manual_seed(5)
    for picture in photographs.colours:
        row, column = (int(torch.randint(n, (1,), generator=generator)) for n in (HEIGHT - 30, WIDTH - 30))
        picture[row : row + 30, column : column + 30] = torch.randint(40, 200, (3,), generator=generator).byte()
    found = gains(photographs, cameras, points, TRAIN)
    # The less photographs agree, the more a single strip may have of a trend, which is the sun's or the light's.
    error = (found / relative(truth)).log()[list(TRAIN)]
    assert error.diff(dim=0).abs().max() < 0.05
    assert error.abs().max() < 0.2


@pytest.mark.parametrize("value", [0, 255])
def test_black_and_saturated_pixels_are_ignored(value: int):
    truth = planted()
    photographs, cameras, points = survey(truth)
    for i in range(3, COUNT, 3):
        photographs.colours[i][:, : WIDTH // 2] = value
    found = gains(photographs, cameras, points, TRAIN)
    assert (found / relative(truth)).log()[list(TRAIN)].abs().max() < 0.01


def test_windows_with_glints_are_ignored_although_their_mean_is_not_clipped():
    truth = planted()
    photographs, cameras, points = survey(truth)
    for i in range(3, COUNT, 3):
        photographs.colours[i][::2, : 3 * WIDTH // 4 : 2] = 255
    found = gains(photographs, cameras, points, TRAIN)
    assert (found / relative(truth)).log()[list(TRAIN)].abs().max() < 0.01


def test_photographs_without_shared_points_follow_the_previous_and_next():
    truth = planted()
    photographs, cameras, points = survey(truth)
    lonely = 5
    keep = points.camera_index != lonely
    cut = SparsePoints(
        points.xyz_world, points.error_px, points.point_index[keep], points.camera_index[keep], points.uv_px[keep]
    )
    found = gains(photographs, cameras, cut, TRAIN)
    assert (found / relative(truth)).log()[lonely].abs().max() < 0.08


def test_the_exif_exposure_of_a_held_out_photograph_is_used():
    log_exposure = torch.zeros(COUNT, dtype=torch.float64)
    log_exposure[::2] = 0.6
    truth = torch.exp(0.5 * log_exposure)[:, None].float().expand(COUNT, 3)
    photographs, cameras, points = survey(truth)
    metadata = Exposures(log_exposure.numpy(), np.full(COUNT, math.nan))
    error = (gains(photographs, cameras, points, TRAIN, metadata) / relative(truth)).log().abs()
    without = (gains(photographs, cameras, points, TRAIN) / relative(truth)).log().abs()
    assert error.max() < 0.02
    assert without[list(TEST)].max() > 0.1


def test_held_out_photographs_as_taken_have_gains_that_suit_the_others_at_a_common_exposure():
    log_exposure = torch.zeros(COUNT, dtype=torch.float64)
    log_exposure[::2] = 0.6
    metadata = Exposures(log_exposure.numpy(), np.full(COUNT, math.nan))
    taken = torch.exp(0.5 * log_exposure)[:, None].float() * torch.tensor([1.0, 0.9, 1.1])
    divided_by = (0.8 * taken).double().numpy()  # the others are 1.25 times the ground now
    divided_by[list(TEST)] = 1.0
    photographs, cameras, points = survey(taken / torch.from_numpy(divided_by).float())
    found = gains(photographs, cameras, points, TRAIN, metadata, divided_by)
    assert found[list(TRAIN)].log().abs().max() < 0.01
    assert (found / (0.8 * taken)).log()[list(TEST)].abs().max() < 0.02
    unaware = gains(photographs, cameras, points, TRAIN, metadata)
    assert (unaware / (0.8 * taken)).log()[list(TEST)].abs().max() > 0.1


def test_exposures_that_the_photographs_contradict_are_ignored():
    log_exposure = torch.linspace(-1, 1, COUNT, dtype=torch.float64).flip(0)[torch.arange(COUNT) * 5 % COUNT]
    photographs, cameras, points = survey(torch.ones(COUNT, 3))
    metadata = Exposures(log_exposure.numpy(), np.full(COUNT, math.nan))
    found = gains(photographs, cameras, points, TRAIN, metadata)
    assert found.log().abs().max() < 0.02


def test_where_many_photographs_share_points_the_gains_are_the_same_without_a_normal_matrix(
    monkeypatch: pytest.MonkeyPatch,
):
    random = np.random.default_rng(0)
    photographs, points, sharing = 90, 120, 80
    photograph = np.concatenate([random.choice(photographs, sharing, replace=False) for _ in range(points)])
    point = np.repeat(np.arange(points), sharing)
    gain, colour = random.normal(0, 0.2, (photographs, 3)), random.normal(4, 0.5, (points, 3))
    value = gain[photograph] + colour[point] + 0.05 * random.standard_t(3, (len(point), 3))
    seen = exposure.Seen(value, point, photograph, np.arange(len(point)), random.normal(0, 0.3, (len(point), 2)))
    monkeypatch.setattr(exposure, "MOST_SHARED", sharing)
    direct, noise = exposure.robust_gains(seen, np.zeros(photographs))
    monkeypatch.setattr(exposure, "MOST_SHARED", sharing - 1)
    monkeypatch.delattr(exposure, "spsolve")
    gains, again = exposure.robust_gains(seen, np.zeros(photographs))
    np.testing.assert_allclose(gains, direct, atol=1e-6)
    assert again == pytest.approx(noise, abs=1e-9)


def test_without_sparse_points_gains_follow_exif_or_are_one():
    photographs, cameras, _ = survey(planted())
    log_exposure = torch.linspace(0, 1, COUNT, dtype=torch.float64)
    nothing = np.full(COUNT, math.nan)
    found = gains(photographs, cameras, None, TRAIN, Exposures(log_exposure.numpy(), nothing))
    assert torch.allclose(found[-1].log() - found[0].log(), torch.full((3,), 0.45), atol=1e-5)
    assert torch.equal(gains(photographs, cameras, None, TRAIN), torch.ones(COUNT, 3))
    assert torch.equal(gains(photographs, cameras, None, TRAIN, Exposures(nothing, nothing)), torch.ones(COUNT, 3))


SWINDALE = SHARED / "scenes" / "swindale" / "images"


@pytest.mark.skipif(not SWINDALE.is_dir(), reason="the swindale photographs are not on this machine")
def test_exposures_and_times_of_a_real_survey_are_read():
    metadata = read_exposures([SWINDALE / f"IMG_{n}.jpg" for n in (1481, 1483, 1484)])
    first, second, third = metadata.log_exposure.tolist()
    assert first - second == pytest.approx(math.log(2))
    assert second == third
    assert np.diff(metadata.time_s).tolist() == [341.0, 6.0]


def test_photographs_without_exif_have_no_exposure_or_time(tmp_path: Path):
    from PIL import Image

    Image.new("RGB", (8, 8)).save(tmp_path / "plain.png")
    broken = Image.new("RGB", (8, 8))
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x829A] = 0.0
    exif.get_ifd(0x8769)[0x9003] = "yesterday"
    broken.save(tmp_path / "odd.jpg", exif=exif)
    metadata = read_exposures([tmp_path / "plain.png", tmp_path / "odd.jpg"])
    assert np.isnan(metadata.log_exposure).all()
    assert np.isnan(metadata.time_s).all()


def exif_of(**tags: object) -> bytes:
    """EXIF with tags of the Exif block, by name."""
    from PIL import ExifTags, Image

    table = Image.Exif()
    table[ExifTags.IFD.Exif] = {ExifTags.Base[name]: value for name, value in tags.items()}
    return table.tobytes()


def test_exif_of_megabytes_counts_as_damaged(tmp_path: Path):
    from PIL import Image

    exif = exif_of(ExposureTime=1 / 100, MakerNote=bytes(1_000_000))
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png", exif=exif)
    assert np.isnan(read_exposures([tmp_path / "a.png"]).log_exposure).all()


def test_a_fraction_of_a_second_in_other_digits_is_none(tmp_path: Path):
    from PIL import Image

    exif = exif_of(DateTimeOriginal="2024:05:06 07:08:09", SubsecTimeOriginal="\u00b2".encode("latin-1"))
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg", exif=exif)
    assert read_exposures([tmp_path / "a.jpg"]).time_s[0] == 1714979289.0


def test_a_factor_that_one_photograph_lacks_is_left_out_for_all(tmp_path: Path):
    from PIL import Image

    picture = Image.new("RGB", (8, 8))
    picture.save(tmp_path / "a.jpg", exif=exif_of(ExposureTime=1 / 100, ISOSpeedRatings=200, FNumber=4.0))
    picture.save(
        tmp_path / "b.jpg", exif=exif_of(ExposureTime=1 / 400, FNumber=2.0, DateTimeDigitized="2024:05:06 07:08:09")
    )
    found = read_exposures([tmp_path / "a.jpg", tmp_path / "b.jpg"])
    assert found.log_exposure == pytest.approx([-math.log(100 * 16), -math.log(400 * 4)])
    assert math.isnan(found.time_s[0])
    assert found.time_s[1] == 1714979289.0


def test_photographs_without_exif_take_no_exposure_or_time_from_the_others(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    from PIL import Image

    picture, paths = Image.new("RGB", (8, 8)), [tmp_path / f"{name}.jpg" for name in "abc"]
    for path, seconds, more in zip(paths[::2], (100, 400), ({"FNumber": 4.0}, {}), strict=True):
        taken = {"ExposureTime": 1 / seconds, "DateTimeOriginal": f"2024:05:06 07:08:{seconds // 10}"}
        picture.save(path, exif=exif_of(**taken, **more))
    picture.save(paths[1])
    with caplog.at_level(logging.INFO):
        found = read_exposures(paths[::2])
        assert not caplog.records
        found = read_exposures(paths)
    assert found.log_exposure == pytest.approx([-math.log(100), math.nan, -math.log(400)], nan_ok=True)
    assert np.diff(found.time_s[::2]) == [30.0]
    assert math.isnan(found.time_s[1])
    assert [record.message.partition(":")[0] for record in caplog.records] == [
        "the EXIF of 1 of 3 photographs has no exposure or no time"
    ]


def test_frames_of_a_video_follow_each_other_by_their_numbers(tmp_path: Path):
    from PIL import Image

    paths = sorted(tmp_path / f"frame_{k}.png" for k in range(1, 13))
    for path in paths:
        Image.new("RGB", (8, 8)).save(path)
    clock = exposure.exposure_and_clock(read_exposures(paths), 12)[1]
    order = [paths[k].stem for k in np.argsort(clock)]
    assert order == [f"frame_{k}" for k in range(1, 13)]
    assert np.isnan(read_exposures(paths[4:]).time_s).all(), "they are in order already"


def test_a_photograph_without_exif_counts_as_those_before_and_after_it():
    log_exposure, time_s = np.arange(5.0), 1e9 + 2 * np.arange(5.0)
    whole = exposure.exposure_and_clock(Exposures(log_exposure, time_s), 5)
    without = Exposures(*(np.where(np.arange(5) == 2, math.nan, values) for values in (log_exposure, time_s)))
    np.testing.assert_allclose(exposure.exposure_and_clock(without, 5), whole, atol=1e-9)
    most = Exposures(log_exposure, np.where(np.arange(5) > 1, math.nan, time_s))
    np.testing.assert_allclose(exposure.exposure_and_clock(most, 5)[1], np.arange(5))


@pytest.mark.parametrize("lacking", [3, TEST[1]])
def test_exif_exposures_are_used_where_one_photograph_has_none(lacking: int):
    log_exposure = torch.zeros(COUNT, dtype=torch.float64)
    log_exposure[[*range(5, 10), TEST[-1]]] = 0.6
    truth = torch.exp(0.5 * log_exposure)[:, None].float().expand(COUNT, 3)
    photographs, cameras, points = survey(truth)
    log_exposure[lacking] = math.nan
    metadata = Exposures(log_exposure.numpy(), np.full(COUNT, math.nan))
    error = (gains(photographs, cameras, points, TRAIN, metadata) / relative(truth)).log().abs()
    without = (gains(photographs, cameras, points, TRAIN) / relative(truth)).log().abs()
    assert error.max() < 0.02
    assert without[list(TEST)].max() > 0.1


def test_exif_of_a_png_is_read_without_decoding_it_and_damaged_exif_counts_as_absent(tmp_path: Path):
    from PIL import Image

    picture = Image.new("RGB", (8, 8))
    whole = exif_of(ExposureTime=1 / 100)
    for name, exif in (("a.png", whole), ("b.png", None), ("c.jpg", b"Exif\0\0nothing of EXIF")):
        picture.save(tmp_path / name, **({} if exif is None else {"exif": exif}))
    for name in ("a.png", "b.png"):  # without their pixels: decoding fails
        data = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(data[: data.index(b"IDAT") + 6])
    assert read_exposures([tmp_path / "a.png"]).log_exposure == pytest.approx([-math.log(100)])
    assert np.isnan(read_exposures([tmp_path / "b.png", tmp_path / "c.jpg"]).log_exposure).all()
    assert len(read_exposures([]).time_s) == 0

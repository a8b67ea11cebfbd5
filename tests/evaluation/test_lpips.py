import os
import shutil

import pytest
import torch

from tidefield.errors import RunError
from tidefield.evaluation import lpips
from tidefield.evaluation.metrics import score
from tidefield.files import file_sha256

HAS_TORCHVISION = lpips.prepare_torchvision() is None
needs_torchvision = pytest.mark.skipif(not HAS_TORCHVISION, reason="torchvision is not installed (the extra [lpips])")


@pytest.fixture
def checkpoints(tmp_path, monkeypatch):
    """An empty folder where torch hub looks for weights."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    return folder


@pytest.fixture
def alexnet(checkpoints, monkeypatch):
    """AlexNet with random weights, saved where its trained ones would be, and under the name of its own hash."""
    from torchvision.models import alexnet

    with torch.random.fork_rng():
        torch.manual_seed(0)
        weights = alexnet().state_dict()
    torch.save(weights, checkpoints / lpips.BACKBONES["lpips_alex"][1])
    sha256 = file_sha256(checkpoints / lpips.BACKBONES["lpips_alex"][1])
    shutil.copy(checkpoints / lpips.BACKBONES["lpips_alex"][1], checkpoints / f"alexnet-random-{sha256[:8]}.pth")
    monkeypatch.setitem(lpips.BACKBONES, "lpips_alex", ("alex", f"alexnet-random-{sha256[:8]}.pth"))
    return checkpoints


def noise(seed: int, height: int = 64, width: int = 80) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (height, width, 3), generator=generator, dtype=torch.uint8)


def test_without_torchvision_the_reason_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(lpips, "find_spec", lambda _: None)
    networks = lpips.load_lpips()
    assert set(networks) == {"lpips_alex", "lpips_vgg"}
    assert all(isinstance(reason, str) and "pip install 'tidefield[lpips]'" in reason for reason in networks.values())


def test_without_weights_the_reason_names_the_file_and_the_commands(checkpoints, monkeypatch):
    monkeypatch.setattr(lpips, "prepare_torchvision", lambda: None)
    networks = lpips.load_lpips()
    for metric, (_, file) in lpips.BACKBONES.items():
        reason = networks[metric]
        assert isinstance(reason, str)
        assert "--download-lpips" in reason
        assert f'curl --create-dirs --output "{checkpoints / file}" {lpips.WEIGHTS_URL}{file}' in reason


def test_the_reason_does_not_name_the_home_folder(checkpoints, monkeypatch):
    monkeypatch.setattr(lpips, "prepare_torchvision", lambda: None)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path.replace("~", str(checkpoints.parent)))
    reason = lpips.load_lpips()["lpips_vgg"]
    assert isinstance(reason, str)
    assert f'--output "$HOME/{checkpoints.name}/vgg16-397923af.pth"' in reason
    assert str(checkpoints) not in reason


def test_without_a_home_folder_the_reason_is_given_all_the_same(monkeypatch):
    monkeypatch.setattr(lpips, "prepare_torchvision", lambda: None)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as of a user that the system does not know
    monkeypatch.delenv("TORCH_HOME", raising=False)
    assert all("--download-lpips" in reason for reason in lpips.load_lpips().values())


def test_a_missing_network_leaves_nulls_with_its_reason_and_all_other_metrics():
    image, truth = noise(1), noise(2)
    seen = torch.ones(image.shape[:2], dtype=torch.bool)
    scores = score(image, truth, seen, dict.fromkeys(lpips.BACKBONES, "it is not here"))
    missing = {name for name, value in scores.values.items() if value is None}
    assert missing == {metric + s for metric in lpips.BACKBONES for s in ("", "_seen", "_cc", "_seen_cc")}
    assert {scores.reasons[name] for name in missing} == {"it is not here"}


def test_images_that_are_too_large_for_the_memory_have_a_reason_and_all_other_metrics(monkeypatch):
    def network(*_: object) -> list[float]:
        raise MemoryError

    image, truth = noise(1), noise(2)
    monkeypatch.setattr(lpips, "memory_bytes", lambda: 2 * 1500 * 80 * 64 - 1)
    assert lpips.too_large("lpips_alex", 80, 64) is None
    scores = score(image, truth, torch.ones(64, 80, dtype=torch.bool), {"lpips_alex": "gone", "lpips_vgg": network})
    assert scores.reasons["lpips_vgg"].startswith("LPIPS of 80 x 64 pixels takes 0.0 GB, more than half of this")
    assert scores.values["psnr"] is not None


def test_a_download_without_a_connection_says_what_to_do(checkpoints, monkeypatch):
    def fail(url: str, dst: str, hash_prefix: str) -> None:
        assert url == lpips.WEIGHTS_URL + "alexnet-owt-7be5be79.pth"
        assert hash_prefix == "7be5be79"
        raise OSError("no route to host")

    monkeypatch.setattr(torch.hub, "download_url_to_file", fail)
    with pytest.raises(RunError, match=r"no route to host.*try again"):
        lpips.download_lpips_weights()


def test_only_published_files_are_not_downloaded_again(checkpoints, monkeypatch):
    asked = []
    monkeypatch.setattr(torch.hub, "download_url_to_file", lambda url, *_: asked.append(url))
    here, other = "alexnet-e244f187.pth", lpips.BACKBONES["lpips_vgg"][1]  # of b"there"
    monkeypatch.setitem(lpips.BACKBONES, "lpips_alex", ("alex", here))
    for file in (here, other):
        (checkpoints / file).write_bytes(b"there")
    assert [path.name for path in lpips.download_lpips_weights()] == [here, other]
    assert asked == [lpips.WEIGHTS_URL + other]


def test_a_file_that_is_not_the_published_one_is_a_reason_not_an_error(checkpoints, monkeypatch):
    monkeypatch.setattr(lpips, "prepare_torchvision", lambda: None)
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("an unknown file was read"))
    path = checkpoints / lpips.BACKBONES["lpips_alex"][1]
    for content, sha256 in ((b"", "e3b0c442"), (b"not weights", "3f0c3b7f")):
        path.write_bytes(content)
        reason = lpips.load_lpips()["lpips_alex"]
        assert isinstance(reason, str)
        assert f"is not the published file (its SHA-256 starts with {sha256})" in reason
        assert str(path) in reason
        assert "curl" in reason


@needs_torchvision
def test_a_full_mask_gives_the_lpips_of_torchmetrics(alexnet):
    from torchmetrics.functional.image.lpips import learned_perceptual_image_patch_similarity

    network = lpips.load_lpips()["lpips_alex"]
    assert isinstance(network, lpips.Lpips)
    image, truth = noise(1), noise(2)
    # torchmetrics finds the same (random) weights in the same place.
    pair = [x.permute(2, 0, 1)[None] / 255 for x in (image, truth)]
    expected = float(learned_perceptual_image_patch_similarity(*pair, net_type="alex", normalize=True))
    everywhere = torch.ones(64, 80, dtype=torch.bool)
    assert network(image, truth, [everywhere])[0] == pytest.approx(expected, rel=1e-5)
    assert expected > 0
    others = [network(image, noise(3), [everywhere])[0], network(image, truth, [everywhere])[0]]
    assert others[1] == pytest.approx(expected, rel=1e-5)
    assert others[0] != others[1], "of another truth, other features"


@needs_torchvision
def test_a_mask_keeps_far_differences_out(alexnet):
    network = lpips.load_lpips()["lpips_alex"]
    assert isinstance(network, lpips.Lpips)
    image = noise(1, 128, 256)
    truth = image.clone()
    truth[:, 192:] = noise(2, 128, 256)[:, 192:]
    left, right = torch.zeros(2, 128, 256, dtype=torch.bool)
    left[:, :64], right[:, 192:] = True, True
    near, far = network(image, truth, [right, left])
    assert far < 0.02 * near


@needs_torchvision
def test_loading_does_not_change_the_random_state(alexnet):
    before = torch.get_rng_state()
    assert isinstance(lpips.load_lpips()["lpips_alex"], lpips.Lpips)
    assert torch.equal(torch.get_rng_state(), before)


def test_operators_are_declared_only_when_torchvision_failed_to_register_them(monkeypatch):
    failures = [RuntimeError("operator torchvision::nms does not exist")]
    imported, declared = [], []

    def importing(name: str) -> None:
        imported.append(name)
        if failures:
            raise failures.pop()

    monkeypatch.setattr(lpips, "find_spec", lambda _: True)
    monkeypatch.setattr(lpips, "import_module", importing)
    monkeypatch.setattr(lpips.sys, "modules", dict(lpips.sys.modules))
    monkeypatch.setattr(torch.library, "define", lambda name, schema: declared.append(name))
    assert lpips.prepare_torchvision() is None
    assert (imported, declared) == (["torchvision"] * 2, ["torchvision::nms", "torchvision::qnms"])
    assert lpips.prepare_torchvision() is None
    assert len(declared) == 2


def test_another_failure_of_torchvision_is_a_reason(monkeypatch):
    def importing(name: str) -> None:
        raise RuntimeError("compiled with different CUDA versions")

    monkeypatch.setattr(lpips, "find_spec", lambda _: True)
    monkeypatch.setattr(lpips, "import_module", importing)
    reason = lpips.load_lpips()["lpips_vgg"]
    assert isinstance(reason, str)
    assert "different CUDA versions" in reason
    assert "pip install --upgrade" in reason

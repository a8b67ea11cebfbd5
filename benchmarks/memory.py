"""Peak memory of rendering one large frame from a scene whose photographs are as large, by default 4000 x 3000.

The scene is the built-in survey with its photographs enlarged, the network is fresh, and the photographs are decoded
by the measured process, as on a machine that sees the scene for the first time.
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

from benchmarks.records import HiddenRunner, say
from tidefield.compare.run import run_measured, tidefield
from tidefield.files import write_json
from tidefield.machine import describe

SURVEY_WIDTH = 400
MEMORY_FILE = "memory.json"


def memory(
    runs: Path,
    preset: Literal["swift", "paper"] = "swift",
    width: int = 4000,
    photographs: int = 12,
    device: str = "cpu",
    run: HiddenRunner = run_measured,
) -> None:
    """Render in a process of its own, and store its time and memory. The scene lies in `runs` as long as it is needed.

    Args:
        runs: Store the figures in this folder's memory.json.
        preset: Which network.
        width: Width of photographs and frame in pixels; the height is three quarters of it.
        photographs: How many the scene has.
        device: auto, cpu, cuda, cuda:N or mps; the figure is of main memory in any case.
        run: Runs the command.
    """
    runs.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=runs, prefix=".memory-") as folder:
        work = Path(folder)
        # In another process, whose memory the measured one is not charged with.
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            name = pool.submit(make_run, work, preset, width, photographs).result()
        command = tidefield("render", work / "run", work / "frame.png", "--camera", name, "--device", device, "--quiet")
        usage = run(command, {"XDG_CACHE_HOME": str(work / "cache")})
    record = {
        "preset": preset,
        "size_px": [width, width * 3 // 4],
        "photographs": photographs,
        "device": device,
        "command": f"python -m benchmarks memory --runs RUNS --preset {preset} --width {width} "
        f"--photographs {photographs} --device {device}",
        **asdict(usage),
        **describe(),
    }
    write_json(runs / MEMORY_FILE, record)
    say(f"{record['peak_memory_bytes'] / 1e9:.2f} GB, {record['seconds']:.0f} s")


def make_run(work: Path, preset: str, width: int, photographs: int) -> str:
    """A scene of large photographs in `work`/scene, and a run of a fresh network on it in `work`/run.

    Returns:
        The name of a held-out photograph.
    """
    import torch
    from PIL import Image

    from tidefield.config import PRESETS
    from tidefield.data.load import load_scene
    from tidefield.synthetic import make_survey, write_survey
    from tidefield.train.checkpoint import Run, write_run
    from tidefield.train.loop import SceneTrainer

    folder = work / "scene"
    survey = make_survey("river_mouths", seed=7, views=photographs, width=min(width, SURVEY_WIDTH))
    write_survey(survey, folder, suffix=".jpg")
    for path in (folder / "images").iterdir():
        with Image.open(path) as picture:
            large = picture.resize((width, width * 3 // 4), Image.Resampling.BICUBIC)
        large.save(path, quality=95)
    # Readers fit the cameras to photographs of another size than the model says. No weight depends on their size, so
    # small ones will do here.
    scene = load_scene(folder, width=min(width, 64))
    write_run(work / "run", Run(folder.resolve(), None, 0, PRESETS[preset]))
    SceneTrainer(PRESETS[preset], scene, 0, torch.device("cpu")).save(work / "run")
    return scene.names[scene.test[-1]]

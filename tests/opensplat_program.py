"""A stand-in for OpenSplat: takes its options, prints and saves as it does, and trains nothing.

It writes one Gaussian, small, white and opaque, in the place of the first sparse point, and behind it a large one of
the colour 0.4. The environment's STAND_IN chooses a mishap.
"""

import json
import os
import sys
import time
from argparse import ArgumentParser
from pathlib import Path

import numpy as np
from gaussian_files import write_gaussians
from plyfile import PlyData

MISHAP = os.environ.get("STAND_IN", "")
C0 = 0.28209479177387814


def install(folder: Path) -> Path:
    """Make a program of this module; returns its path."""
    program = folder / "opensplat"
    lines = [f"#!{sys.executable}", "import sys", f"sys.path.insert(0, {str(Path(__file__).parent)!r})"]
    program.write_text("\n".join([*lines, "import opensplat_program", "opensplat_program.main()"]))
    program.chmod(0o755)
    return program


def main() -> None:
    parser = ArgumentParser()
    parser.add_argument("input", nargs="?")
    parser.add_argument("-o", "--output", default="splat.ply")
    parser.add_argument("-n", "--num-iters", type=int, default=30000)
    parser.add_argument("-s", "--save-every", type=int, default=-1)
    parser.add_argument("-d", "--downscale-factor", type=float, default=1)
    for flag in ("--keep-crs", "--cpu", "--version"):
        parser.add_argument(flag, action="store_true")
    options = parser.parse_args()
    if options.version:
        print("0.9.2" if MISHAP == "old" else "1.1.4 (git commit 1234567)")
        return
    root, out = Path(options.input), Path(options.output)
    top = json.loads((root / "transforms.json").read_text())
    print("Using CPU", flush=True)
    for frame in top["frames"]:
        print("Loading", root / frame["file_path"], flush=True)
    points = PlyData.read(root / top["ply_file_path"])["vertex"].data
    first = np.array([float(points[axis][0]) for axis in "xyz"])
    (out.parent / "words").write_text(" ".join(sys.argv[1:]))
    if MISHAP == "fails":
        sys.exit("it ran out of luck")
    if MISHAP == "slow to load":
        time.sleep(1)
    for step in range(1, options.num_iters + 1):
        time.sleep(0.01)
        print(f"Step {step}: 0.1 (0%)", flush=True)
        if options.save_every > 0 and step % options.save_every == 0 and MISHAP != "saves nothing":
            if MISHAP == "saves slowly":
                time.sleep(0.5)
            save(out.with_name(f"{out.stem}_{step}{out.suffix}"), first)
    (out.parent / "cameras.json").write_text("[]")
    save(out, first)


def save(path: Path, first: np.ndarray) -> None:
    if MISHAP == "garbage":
        path.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 7\n")
        return
    write_gaussians(
        path,
        mean=[first, np.add(first, (0, 0, 20))],
        scale=[[0.1] * 3, [1e4, 1e4, 0.01]],
        rotation=[[1, 0, 0, 0]] * 2,
        opacity=[0.9999, 0.9999],
        harmonics=np.array([[[0.5 / C0]] * 3, [[-0.1 / C0]] * 3]),
    )

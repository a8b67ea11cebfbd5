"""What can be asked of each command: its arguments, their defaults and their help.

The command line is made from these, and the commands take them whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

Preset = Literal["swift", "paper"]
Floor = Literal["plane-sweep", "sparse-depth", "nearest"]
Trained = Literal["tidefield", "nerf", "nerfacto", "splatfacto"]
Compared = Literal[
    "tidefield",
    "zero-shot",
    "paper",
    "paper-zero-shot",
    "nerf",
    "nerfacto",
    "splatfacto",
    "plane-sweep",
    "sparse-depth",
    "nearest",
]
Stage = Literal["quality", "features", "pairs", "matches", "poses", "georeference", "images"]
Device = Annotated[str, arg(help="auto, cpu, cuda, cuda:N or mps.")]
AllowMissing = Annotated[bool, arg(help="Go on without photographs that the scene names but does not have.")]


@dataclass(frozen=True)
class Verbosity:
    """How much is said."""

    verbose: Annotated[bool, arg(aliases=["-v"])] = False
    """Say more."""
    quiet: Annotated[bool, arg(aliases=["-q"])] = False
    """Say nothing but errors."""


@dataclass(frozen=True)
class Length:
    """How long to train."""

    minutes: float | None = None
    """So long; 10 if neither this nor --steps is given."""
    steps: int | None = None
    """So many steps instead."""


@dataclass(frozen=True)
class ZeroShot:
    """A scene as it is, with weights that were trained elsewhere, instead of a run."""

    zero_shot: bool = False
    """Do so."""
    preset: Preset = "swift"
    """The network."""
    weights: Path | None = None
    """Its weights, of `tidefield pretrain`; those that came with Tidefield if not given."""


@dataclass(frozen=True)
class Train:
    """Train on one scene and keep the result in a run folder.

    Ctrl-C saves before it stops; --resume goes on from there.
    """

    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    """Folder with posed photographs: a COLMAP model, transforms.json, ODM's or OpenSfM's project, Blender or LLFF."""
    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder for the result; must be new, unless --resume or --overwrite is given."""
    preset: Preset = "swift"
    """swift is the best quality for the time; paper is the network as printed."""
    variant: str | None = None
    """Change one part of the preset, as `tidefield ablate` does."""
    method: Trained = "tidefield"
    """Train a peer instead: classical NeRF, or nerfstudio's nerfacto or splatfacto, which `tidefield baselines install
    nerfacto` installs."""
    length: OmitArgPrefixes[Length] = Length()
    width: int | None = None
    """Width of the photographs in pixels; their own if not given."""
    device: Device = "auto"
    seed: int = 0
    """Of the weights and of the order of the photographs."""
    from_scratch: bool = False
    """Begin with random weights instead of those that came with Tidefield."""
    weights: Path | None = None
    """Begin with these weights, of `tidefield pretrain`."""
    field: bool = False
    """Add the per-scene field (a hash grid) to what the neighbours say."""
    resume: bool = False
    """Go on with the run that is in the folder."""
    overwrite: bool = False
    """Replace the run that is in the folder."""
    curve: bool = False
    """Render two held-out views at a quarter of their size now and then, for a curve of quality against time; the
    clock stands still meanwhile."""
    allow_missing: AllowMissing = False
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


@dataclass(frozen=True)
class Pretrain:
    """Train across scenes, for weights that work where nothing was trained: procedural tidal flats, and real scenes.

    Writes OUT/weights.safetensors. Ctrl-C saves before it stops; --resume goes on from there. Several GPUs or machines
    train together under torchrun: `torchrun --nproc-per-node 4 -m tidefield.cli pretrain OUT --steps 100000`.
    """

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder for the result; must be new, unless --resume is given."""
    real: tuple[Path, ...] = ()
    """Scenes to learn from, too; of them only the training photographs."""
    preset: Preset = "swift"
    length: OmitArgPrefixes[Length] = Length()
    seed: int = 0
    """Of the weights, the scenes and their order."""
    device: Device = "auto"
    resume: bool = False
    """Go on with what is in the folder."""
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


@dataclass(frozen=True)
class Evaluate:
    """Compare renderings of the held-out photographs with the photographs.

    Writes evaluation.json and pictures: `tidefield evaluate RUN` into the run, `tidefield evaluate SCENE OUT --method
    sparse-depth` into a folder of its own, for methods that need no training.
    """

    source: Annotated[Positional[Path], arg(metavar="RUN|SCENE")]
    """A run, or with --method or --zero-shot a scene."""
    out: Annotated[Positional[Path | None], arg(metavar="[OUT]")] = None
    """Where to write; the run itself if not given."""
    method: Floor | None = None
    """Evaluate this method on a scene instead of a run."""
    zero: OmitArgPrefixes[ZeroShot] = ZeroShot()
    width: int | None = None
    """Width of the photographs in pixels, with --method or --zero-shot; a run knows its own."""
    device: Device = "auto"
    download_lpips: bool = False
    """Fetch the weights that LPIPS needs (AlexNet 233 MB, VGG 528 MB) if they are not there."""
    overwrite: bool = False
    """Replace an evaluation that is there."""
    allow_missing: AllowMissing = False
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


@dataclass(frozen=True)
class Render:
    """Render a video along a path (OUT.mp4), or the view of one photograph's camera with its depth (OUT.png)."""

    source: Annotated[Positional[Path], arg(metavar="RUN|SCENE")]
    """A trained run, or with --zero-shot a scene."""
    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """The file to write; .mp4 for a video, .png with --camera."""
    path: str = "orbit"
    """orbit, cameras (a flight among them), strip (straight down) or a camera-path JSON of nerfstudio's viewer."""
    camera: str | None = None
    """Name of a photograph whose camera is rendered instead of a path."""
    zero: OmitArgPrefixes[ZeroShot] = ZeroShot()
    frames: int = 240
    """Frames of the video; 24 are a second."""
    width: int | None = None
    """Width of the picture in pixels; that of the run's photographs if not given."""
    height: int | None = None
    """Height of the picture in pixels; in proportion to the width if not given."""
    device: Device = "auto"
    overwrite: bool = False
    """Replace files that are there."""
    allow_missing: AllowMissing = False
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


@dataclass(frozen=True)
class Prepare:
    """Make a scene of a folder of drone photographs: quality, poses, place on the Earth, colours and a report.

    The scene has a COLMAP model and a transforms.json: COLMAP, nerfstudio, gsplat and OpenSplat open it, too. Ctrl-C
    loses at most the running stage; the same command goes on, and a changed option redoes only what depends on it.
    """

    photographs: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder with the photographs (JPEG, PNG, TIFF), in sub-folders too."""
    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    """Folder for the scene: a new one, or one to go on with."""
    gps: Path | None = None
    """Positions of the photographs (gps.csv or ODM's geo.txt), instead of EXIF's; without it, such a file beside the
    photographs is used where EXIF has none."""
    control: Path | None = None
    """Ground control (ODM's gcp_list.txt); without it, such a file beside the photographs is used."""
    no_control: Annotated[bool, arg(name="no-control", help="Use no ground control, even if it is there.")] = False
    keep_all: bool = False
    """Use photographs of low quality, too."""
    colour: Literal["auto", "on", "off"] = "auto"
    """Even out exposures and the lens' falloff: where it helps, always, or never."""
    features: int = 6000
    """Features to find in each photograph, at most."""
    feature_width: int = 2400
    """Longer side in pixels to which larger photographs are reduced to find features."""
    redo: Stage | None = None
    """Do this stage again, and all that follow."""
    device: Annotated[str, arg(help="auto, cpu or cuda: where features are found and matched.")] = "auto"
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


@dataclass(frozen=True)
class Import:
    """Make a scene of a project of ODM or OpenSfM, of a COLMAP model, or of nerfstudio's transforms.json.

    Poses and photographs stay as they are. The scene has a COLMAP model and a transforms.json: COLMAP, nerfstudio,
    gsplat and OpenSplat open it, too.
    """

    project: Annotated[Positional[Path], arg(metavar="PROJECT")]
    """The folder of the project or scene."""
    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    """Folder for the scene; must be new."""
    link: bool = False
    """Give the photographs a second name (hard links) instead of copying them."""
    allow_missing: AllowMissing = False
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


@dataclass(frozen=True)
class Compare:
    """Train and evaluate methods on the same scenes, split, resolution, machine and budget; write tables and figures.

    What is done is not repeated: the same command goes on after an interruption, and with more methods or scenes.
    """

    scenes: Annotated[Positional[tuple[Path, ...]], arg(metavar="[SCENE ...]")] = ()
    """Scenes; with --protocol tidalflats in addition to its own, with --protocol mipnerf360 the folder of the data
    set."""
    methods: tuple[Compared, ...] = ("tidefield", "nerfacto", "plane-sweep", "sparse-depth", "nearest")
    """Which, in the order of the tables. tidefield and paper are presets of ours, zero-shot and paper-zero-shot these
    without any training on the scene; nerf is classical NeRF; nerfacto and splatfacto are nerfstudio's; the others
    need no training."""
    length: OmitArgPrefixes[Length] = Length()
    width: int | None = None
    """Width of the photographs in pixels; their own if not given."""
    from_scratch: bool = False
    """Begin our presets with random weights."""
    protocol: Literal["mipnerf360", "tidalflats"] | None = None
    """Scenes with a name: the seven public ones of mip-NeRF 360, or five synthetic tidal flats."""
    out: Path = Path("comparison")
    """Folder for the runs, tables and figures."""
    device: Device = "auto"
    seed: int = 0
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


@dataclass(frozen=True)
class Ablate:
    """Train and evaluate variants of a preset, each with one part left out or changed, and write a table for each
    scene.

    What is done is not repeated: the same command goes on after an interruption, and with more variants or scenes.
    """

    scenes: Annotated[Positional[tuple[Path, ...]], arg(metavar="SCENE [SCENE ...]")]
    variants: tuple[str, ...] = ()
    """Which; all of them if not given."""
    preset: Preset = "swift"
    """What they are variants of."""
    length: OmitArgPrefixes[Length] = Length()
    width: int | None = None
    """Width of the photographs in pixels; their own if not given."""
    out: Path = Path("ablation")
    """Folder for the runs and the table."""
    device: Device = "auto"
    seed: int = 0
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


@dataclass(frozen=True)
class Baselines:
    """Install the peers that live in environments of their own."""

    action: Positional[Literal["install"]]
    """What to do."""
    name: Positional[Literal["nerfacto"]]
    """nerfacto is nerfstudio, with splatfacto."""
    overwrite: bool = False
    """Begin anew where it is installed already."""
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


@dataclass(frozen=True)
class Demo:
    """The whole job on a built-in scene: make a survey of a tidal flat, train, evaluate, and render a fly-through."""

    out: Annotated[Positional[Path], arg(metavar="[OUT]")] = Path("tidefield-demo")
    """Folder to write to."""
    minutes: float = 3.0
    """Minutes of training."""
    device: Device = "auto"
    overwrite: bool = False
    """Begin anew in a folder that holds a demonstration; without it, what is there is used and finished."""
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()

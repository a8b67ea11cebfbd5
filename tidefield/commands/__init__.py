"""What the commands do, once their arguments are known."""

from tidefield.commands.demonstration import demo
from tidefield.commands.peers import ablate, baselines, compare
from tidefield.commands.surveys import import_project, prepare
from tidefield.commands.training import pretrain, train
from tidefield.commands.views import evaluate, render

__all__ = [
    "ablate",
    "baselines",
    "compare",
    "demo",
    "evaluate",
    "import_project",
    "prepare",
    "pretrain",
    "render",
    "train",
]

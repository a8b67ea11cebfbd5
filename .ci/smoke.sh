#!/usr/bin/env bash
# The main job with an installed tidefield, in a minute: photographs to a scene, 20 steps of training, two views.
# Usage: .ci/smoke.sh PYTHON, in an environment's bin folder.
set -euo pipefail
python=$1
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
export XDG_CACHE_HOME=$work/cache
"$python" - <<'PYTHON'
from pathlib import Path

from tidefield.synthetic import make_survey, write_survey

write_survey(make_survey("ground_textures", seed=3, views=12, width=480, supersample=1), Path("flat"), suffix=".jpg")
PYTHON
tidefield="$python -m tidefield.cli"
$tidefield prepare flat/images scene --keep-all
$tidefield train scene run --width 240 --steps 20
$tidefield evaluate run
name=$(basename "$(find scene/images -name '*.jpg' | sort | head -n 1)")
$tidefield render run view.png --camera "$name" --width 120
$tidefield render scene zero-shot.png --zero-shot --camera "$name" --width 120
ls -l view.png zero-shot.png

# Every target sets up what it needs in a virtual environment of its own, once.
PYTHON ?= python3
VENV ?= .venv
OUT ?= tidefield-demo
ARGS ?=

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install -c constraints.txt
REQUIRED := pyproject.toml constraints.txt $(VENV)/.made

.PHONY: demo test bench kills fuzz lint docs lowest clean help
.DELETE_ON_ERROR:

help:
	@echo "make demo     the whole job on the built-in scene, into $(OUT)/ (OUT=FOLDER for another)"
	@echo "make test     the tests (ARGS=... for pytest)"
	@echo "make bench    the benchmarks (ARGS=... for them)"
	@echo "make kills    commands killed at random moments, and what they complete afterwards"
	@echo "make fuzz     damaged files for everything that reads files (ARGS=\"--minutes 10\")"
	@echo "make lint     ruff and pyright"
	@echo "make docs     the site, in docs/_build/html"
	@echo "make lowest   the main job with the lowest promised versions, in $(VENV)-lowest"
	@echo "make clean    remove the virtual environment, which the next target makes again"
	@echo "PYTHON=python3.12 chooses another Python than python3, before the environment is made."

demo: $(VENV)/.installed
	$(BIN)/tidefield demo $(OUT) $(ARGS)

# Sharing these small tensor operations between threads costs more than it gains, many times more on busy cores.
# Without bytecode on disk, every worker and child process would compile all modules again.
test: $(VENV)/.installed-dev
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --maxprocesses 8 --dist loadfile $(ARGS)

bench: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks $(ARGS)

kills: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks kills $(ARGS)

fuzz: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks fuzz $(ARGS)

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

# -W: a warning is an error; --keep-going: all of them are printed.
docs: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html

# The main job with the lowest versions of the dependencies that pyproject.toml promises, in an environment of its own.
lowest: $(VENV)/.installed-dev $(VENV)-lowest/.installed
	.ci/smoke.sh $(CURDIR)/$(VENV)-lowest/bin/python

$(VENV)-lowest/.installed: $(REQUIRED) $(VENV)/.installed-dev
	$(PYTHON) -m venv $(VENV)-lowest
	$(BIN)/python .ci/lowest.py > $(VENV)-lowest/constraints.txt
	$(VENV)-lowest/bin/python -m pip --disable-pip-version-check install -c $(VENV)-lowest/constraints.txt -e .
	touch $@

clean:
	rm -rf $(VENV) $(VENV)-lowest

$(VENV)/.made:
	@command -v $(PYTHON) > /dev/null || \
		{ echo "There is no $(PYTHON) here: expected Python 3.11 or newer; install it or name it, as in PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; v = sys.version.split()[0]; sys.version_info >= (3, 11) or sys.exit("$(PYTHON) is Python " + v + ": expected 3.11 or newer; name one, as in: make $(MAKECMDGOALS) PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	touch $@

# Editable, so that only new requirements make it install again.
$(VENV)/.installed: $(REQUIRED)
	$(PIP) -e .
	touch $@

$(VENV)/.installed-dev: $(REQUIRED)
	$(PIP) -e '.[dev]' -e ./weights/paper
	touch $(VENV)/.installed $@

$(VENV)/.installed-docs: $(REQUIRED)
	$(PIP) -e '.[docs]'
	touch $(VENV)/.installed $@

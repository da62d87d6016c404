# make train   set up and train POR on pouring: make train ARGS="-n 2500 --seed 1"
# make test    set up and run the tests:        make test ARGS="-k plots"
# make demo    a small run from training to a curve and a GIF, within 5 minutes on two CPU cores
# make docs    build the documentation site into site/
# make soak    play all tasks for an hour (SOAK=15: 15 minutes) and audit the physics and the process
# make lint, make format, make type, make bench

VENV := .venv
BIN := $(VENV)/bin
ARGS ?=
SOAK ?= 60

# The first interpreter that pybullet or its fork has wheels for; PYTHON=... names another. The original draws faster.
SUPPORTED := import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))
PYTHON ?= $(shell for p in python3.11 python3.10 python3.13 python3.12 python3 python; do \
	$$p -c '$(SUPPORTED)' >/dev/null 2>&1 && { echo $$p; break; }; done)

export MPLBACKEND := Agg

.PHONY: train test demo docs lint format type bench soak

train: $(VENV)/.installed-test
	$(BIN)/python train.py --algo sac_por --env PourWater-v0 $(ARGS)

test: $(VENV)/.installed-test
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto --dist loadfile $(ARGS)

DEMO := demo/$(shell date +%Y%m%d-%H%M%S)
DEMO_RUN := $(DEMO)/sac_por/PourWater-v0_1

demo: $(VENV)/.installed-test
	$(BIN)/python train.py --algo sac_por --env PourWater-v0 --seed 1 -n 1000 --eval-freq 200 --eval-episodes 5 \
		-f $(DEMO) -params learning_starts:600 buffer_size:3000 $(ARGS)
	$(BIN)/python -m sb3_por evaluate --model $(DEMO_RUN)/best_model.zip --env PourWater-v0 -n 10
	$(BIN)/python -m sb3_por plot $(DEMO_RUN) -o $(DEMO)/curve.png
	$(BIN)/python -m sb3_por enjoy --model $(DEMO_RUN)/best_model.zip --env PourWater-v0 -o $(DEMO)/pour_water.gif
	@printf 'model  %s\ncurve  %s\nGIF    %s\n' $(DEMO_RUN)/best_model.zip $(DEMO)/curve.png $(DEMO)/pour_water.gif

# The variable silences an advertisement of the theme's successor.
docs: $(VENV)/.installed-docs
	@$(BIN)/python -c 'import mkdocs' 2>/dev/null || { echo "make: the site's tools need Python 3.11 to 3.13" >&2; exit 2; }
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet $(ARGS)
	@echo "site/index.html; with its search: $(BIN)/python -m http.server --directory site"

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/black --check .

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/black .

type: $(VENV)/.installed-dev
	$(BIN)/mypy

bench: $(VENV)/.installed-test
	for benchmark in $(filter-out benchmarks/soak.py,$(wildcard benchmarks/*.py)); do $(BIN)/python $$benchmark $(ARGS) || exit; done

soak: $(VENV)/.installed-test
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/soak.py --minutes $(SOAK) $(ARGS)

# One stamp for each set of extras: installed again only when setup.cfg or constraints.txt changed.
$(VENV)/.installed-test: EXTRAS := test,docs
$(VENV)/.installed-docs: EXTRAS := docs
$(VENV)/.installed-dev: EXTRAS := test,dev
$(VENV)/.installed-%: setup.cfg constraints.txt | $(BIN)/pip
	$(BIN)/python -m pip install -q -c constraints.txt -e '.[$(EXTRAS)]'
	@touch $@

$(BIN)/pip:
	@$(if $(PYTHON),$(PYTHON),false) -c '$(SUPPORTED)' || { printf '%s\n' \
		"make: $(or $(PYTHON),what was found) is not Python 3.10 to 3.13, and pybullet has wheels for no other. Type" \
		"    uv python install 3.13" \
		"    make $(MAKECMDGOALS) PYTHON=\"\$$(uv python find 3.13)\"" \
		"or name one that you have: make $(MAKECMDGOALS) PYTHON=/path/to/python3.13" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)

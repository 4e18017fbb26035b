# make demo   sets everything up, trains a residual in a jam, and compares drivers with human drivers there: a minute or two after
#             the installation
# make test   six tests of seven, in minutes, as .ci/run does; make test-all adds the long and the slow ones
# make check  lint, format, types; make docs builds the site; make bench measures speed
#
# On a machine where pip would fetch a CUDA build of torch, the CPU build is a tenth of the size:
#   make demo TORCH_INDEX="--index-url https://download.pytorch.org/whl/cpu"

PYTHON ?= python3
VENV ?= .venv
TORCH_INDEX ?=
# What the commands of README.md need: no pettingzoo, no ray
DEMO_EXTRAS := sign,train,tune,video
BIN := $(VENV)/bin
# Compiling all that is installed takes as long as installing it, and most of it is never imported
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --no-compile -c constraints.txt

.PHONY: demo test test-all coverage check bless pages docs bench soak clean

# Each process finds what another has compiled
export PYTHONDONTWRITEBYTECODE =

demo: $(VENV)/.installed
	$(BIN)/unjam train ring-jammed --preset demo
	$(BIN)/unjam drive ring-jammed -d human -d pi -d unjam:ring-jammed-tuned -d unjam:ring-jammed-best --test-seeds -n 4

# The tests of a file share what they have made
SPREAD := -n 2 --dist loadfile --no-loadscope-reorder
# With TESTS="" also those that are long or slow
TESTS ?= -m "not slow and not long"

# Two processes share two cores: threads of more than one would wait for each other
test: export OMP_NUM_THREADS = 1
test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest $(SPREAD) $(TESTS)

test-all: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -n 2 --hypothesis-profile=thorough

# Which lines no test runs
coverage: TESTS = -m "not slow"
coverage: $(VENV)/.installed-dev
	$(BIN)/python -m pytest $(SPREAD) $(TESTS) --cov --cov-report=term

check: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

# Trajectories that have changed, and rightly so: make bless WHY="why they have"
bless: $(VENV)/.installed-dev
	$(BIN)/python tests/golden/bless.py "$(WHY)"

# The tables and pictures of the pages, and CLAIMS.md, from results/
pages: $(VENV)/.installed-dev
	$(BIN)/python docs/pages.py
	$(BIN)/python docs/claims.py

# SPHINXOPTS="-D nb_execution_mode=off" does not run the notebooks
docs: $(VENV)/.installed-dev
	$(BIN)/python -m sphinx -q -E -W -b html $(SPHINXOPTS) docs docs/_build/html
	@echo docs/_build/html/index.html

# Thousands of injected faults, half an hour: results/soak.json
soak: $(VENV)/.installed-dev
	$(BIN)/python tests/faults/soak.py

bench: $(VENV)/.installed
	$(BIN)/unjam bench

clean:
	rm -rf $(VENV) docs/_build .pytest_cache .ruff_cache

# What comes with Python is an old pip, which takes twice as long
define set_up
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "unjam needs Python 3.11 or newer; name one: make demo PYTHON=python3.11"; exit 3; }
	@echo "setting up $(VENV): a few minutes, once"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(PIP) "pip>=26"
	@$(PIP) $(TORCH_INDEX) torch
	@$(PIP) -e ".[$(1)]"
	@touch $@
endef

$(VENV)/.installed: pyproject.toml constraints.txt
	$(call set_up,$(DEMO_EXTRAS))

# with what tests, checks and docs need
$(VENV)/.installed-dev: pyproject.toml constraints.txt
	$(call set_up,dev)
	@touch $(VENV)/.installed

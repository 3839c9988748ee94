# `make` alone lists what there is. Variables: ROBOT, TASK, RECIPE, SEED, RUN (name of the run), ARGS.
ROBOT ?= pendubot
TASK ?= v2
RECIPE ?= learned
SEED ?= 0
RUN ?= $(ROBOT)$(if $(filter v2,$(TASK)),$(if $(filter learned,$(RECIPE)),,-$(RECIPE)),-$(TASK))-seed$(SEED)
ARGS ?=
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

ifeq ($(filter $(ROBOT),acrobot pendubot),)
$(error ROBOT is '$(ROBOT)'; it must be acrobot or pendubot)
endif
ifeq ($(filter $(TASK),v2 global hardware),)
$(error TASK is '$(TASK)'; it must be v2, global or hardware)
endif

ifneq ($(and $(filter global hardware,$(TASK)),$(filter-out file,$(origin RECIPE))),)
$(error TASK is '$(TASK)' and RECIPE is '$(RECIPE)'; recipes are of v2, leave one of them out)
endif
BOARD = --board $(or $(BOARD_$(TASK)),$(TASK))
BOARD_global := v3

# What `make train` reads: a recipe that ships with the package.
CONFIG = $(if $(filter v2,$(TASK)),$(CONFIG_OF_RECIPE),$(TASK)_$(ROBOT))
CONFIG_OF_RECIPE = $(or $(CONFIG_$(RECIPE)),$(error RECIPE is '$(RECIPE)'; it must be learned, demonstrated, low_torque or plain))
CONFIG_learned := $(ROBOT)
CONFIG_demonstrated := demonstrated_$(ROBOT)
CONFIG_plain := plain
CONFIG_low_torque := low_torque

.DEFAULT_GOAL := help
.PHONY: help install train snes score robustness hardware leaderboard runs report docs test lint bench clean

help:  ## list the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12
	@echo
	@echo "variables: ROBOT=acrobot|pendubot  TASK=v2|global|hardware  RECIPE=learned|demonstrated|low_torque|plain  SEED=0  RUN=name  ARGS='--sac.steps 100000'"
	@echo "the command behind them, with its own --help: $(BIN)/jaxpend"

$(STAMP): pyproject.toml .constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and \
	  f"jaxpend needs Python 3.11 or newer, not {v[0]}.{v[1]}: make PYTHON=/path/to/python3")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --no-compile --disable-pip-version-check -c .constraints.txt -e '.[dev]'
	@touch $@

install: $(STAMP)  ## make .venv with pinned versions

train: $(STAMP)  ## train for TASK=v2|global|hardware, v2 by RECIPE=...; ends with the official score
	$(BIN)/jaxpend train --config $(CONFIG) --robot $(ROBOT) --seed $(SEED) --run $(RUN) $(ARGS)

snes: $(STAMP)  ## fine-tune by SNES: ARGS='--policy FILE' or '--controller NAME'
	$(BIN)/jaxpend snes $(BOARD) --robot $(ROBOT) --seed $(SEED) $(ARGS)

score: $(STAMP)  ## official score of the shipped policy, or ARGS='--policy FILE'
	$(BIN)/jaxpend score $(BOARD) --robot $(ROBOT) $(ARGS)

robustness: $(STAMP)  ## six-criterion robustness of the shipped policy, or ARGS='--policy FILE'
	$(BIN)/jaxpend robustness --robot $(ROBOT) --seed $(SEED) $(ARGS)

hardware: $(STAMP)  ## how many of 1000 real robots the shipped policy brings up, or ARGS='--policy FILE'
	$(BIN)/jaxpend hardware --robot $(ROBOT) --seed $(SEED) $(ARGS)

leaderboard: $(STAMP)  ## every known controller on the board of ROBOT, next to the published rows
	$(BIN)/jaxpend leaderboard $(BOARD) --robot $(ROBOT) $(ARGS)

runs: $(STAMP)  ## list the runs with their state and scores
	$(BIN)/jaxpend runs $(ARGS)

report: $(STAMP)  ## one page about the run RUN, with pictures
	$(BIN)/jaxpend report runs/$(RUN) $(ARGS)

docs: $(STAMP)  ## the reference: build/docs/index.html, from the docstrings
	$(BIN)/python experiments/reference.py $(ARGS)

test: $(STAMP)  ## the test suite
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder $(ARGS)

lint: $(STAMP)  ## ruff: rules and format; mypy: types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(STAMP)  ## time every part on this machine, beside other ways to do it (half an hour)
	$(BIN)/python experiments/bench $(ARGS)

clean:  ## remove the virtual environment and caches; runs/ stays
	rm -rf $(VENV) .mypy_cache .pytest_cache .ruff_cache .hypothesis build *.egg-info
	find jaxpend tests experiments -name __pycache__ -type d -exec rm -rf {} +

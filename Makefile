# push_ident: `make help` lists what there is.
SHELL := /bin/bash
.DEFAULT_GOAL := help

# The interpreter that .venv is made from: the first one of 3.12 and 3.11 that starts. Another: make setup PYTHON=/path/to/python3.11
ifndef PYTHON
PYTHON := $(shell for p in python3.12 python3.11 python3; do \
  "$$p" -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' >/dev/null 2>&1 && echo "$$p" && break; done)
endif
VENV := .venv/bin

.PHONY: help setup setup-dev demo docs bench experiments blind recordings scenes labelled held-out obstacles two-fingers states faults fuzz test test-long test-oldest test-release lint format dist dist-check changelog release clean

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## */  make \1\t/' | expand -t 16

setup:  ## .venv with the packages that nodes and commands use, pinned, ROS 2 Jazzy, workspace built; again: a second
	@if [ -z "$(PYTHON)" ]; then \
	  echo "make setup: no Python 3.11 or 3.12 found; install one (Debian: apt-get install python3 python3-venv python3-dev)" \
	       "or name it: make setup PYTHON=/path/to/python3.12" >&2; exit 1; fi
	@$(PYTHON) tools/setup_workspace.py $(FURTHER)

DEV := dev docs fleet torch
setup-dev: FURTHER = $(DEV)
setup-dev: setup  ## the same, with what tests, checks, documentation and fleets need

demo: setup  ## the whole path on a simulated cell: observe, push, identify, predict
	$(VENV)/push-ident demo

docs: setup-dev  ## the documentation site, in out/site; open out/site/index.html
	NO_MKDOCS_2_WARNING=1 $(VENV)/mkdocs build
	@echo "written: out/site/index.html"

bench: setup-dev  ## time and error of engine, identification, perception, scenes and rivals (half an hour; Newton: requirements/newton.txt), then docs/results/benchmarks.md
	$(VENV)/push-ident bench --page docs/results/benchmarks.md

# The published seeds.
comma := ,
experiment = $(VENV)/push-ident experiment $(1) --json docs/results/$(firstword $(1)).json
experiments: setup-dev  ## the paper's experiments and those of pushing to goals (hours; goes on where it stopped), then their pages
	$(call experiment,convergence --models 1)
	$(call experiment,maps --models 2)
	$(call experiment,coverage --models 2)
	$(call experiment,few-pushes --models 10)
	$(call experiment,goals --seed 41000 --models 8)
	$(call experiment,edge --seed 44000 --models 25)
	$(call experiment,paths --seed 52000 --models 4)
	$(call experiment,sensors --seed 5000 --models 1)
	$(call experiment,demo --seed 8745 --models 5)
	-$(call experiment,pusht --models 20 --goals 25)  # needs requirements/pusht.txt
	$(VENV)/push-ident experiment report

MINUTES ?= 60
fuzz: setup-dev  ## any message for every conversion and node, any bag, any depth frame, for about MINUTES=60; a failure becomes an @example
	FUZZ_MINUTES=$(MINUTES) $(VENV)/pytest -vv -m fuzz $(call with_marker,fuzz)

blind: setup-dev  ## the diagnosis on sealed cases of two other engines (twenty minutes; the published seeds), then the page
	$(call experiment,blind --seed 54000 --models 12 --variants 14-pushes$(comma)camera)
	$(VENV)/push-ident experiment report

DATA ?= ../shared/data
recordings: setup-dev  ## recordings of others, set by set, DATA=FOLDER of them (goes on where it stopped), then the page
	$(call experiment,recorded --models 2 --recordings "$(DATA)")
	$(VENV)/push-ident experiment report

SETS ?= sensor_log
held-out: setup-dev  ## recorded pushes known by their ends, SETS=FOLDER of sets of 35 pushes and more (half an hour), then the page
	$(call experiment,held-out --models 5 --recordings "$(SETS)")
	$(VENV)/push-ident experiment report

obstacles: setup-dev  ## pushing to goals between obstacles, and several objects to theirs, in Bullet (hours; goes on where it stopped), then the pages
	$(call experiment,obstacles --seed 400 --models 4 --goals 5 --variants round)
	$(call experiment,several --seed 400 --models 8)
	$(VENV)/push-ident experiment report

FINGERS ?= robot_exp_logs
two-fingers: setup-dev  ## recorded pushes with two fingers, FINGERS=FOLDER of their logs (half an hour), and stable pushes in Bullet, then the pages
	$(call experiment,two-fingers --models 5 --recordings "$(FINGERS)")
	$(call experiment,stable-pushes --seed 700 --models 1 --goals 4)
	$(VENV)/push-ident experiment report

injected: setup-dev  ## known causes put into recordings of others, DATA=FOLDER of them (goes on where it stopped), then the page
	$(call experiment,injected --seed 430 --models 8 --variants single$(comma)single-against-half$(comma)pair-against-half$(comma)against-half --recordings "$(DATA)")
	$(VENV)/push-ident experiment report

scenes: setup-dev  ## scenes of MuJoCo and Bullet made wrong in a known way, and recordings in DATA=FOLDER against a plain scene, then the pages
	$(call experiment,scenes --seed 4000 --models 10)
	$(call experiment,recorded-scenes --models 1 --recordings "$(DATA)")
	$(VENV)/push-ident experiment report

labelled: setup-dev  ## perception on labelled depth frames, DATA=FOLDER of organised clouds (minutes), then the page
	$(call experiment,labelled --models 1 --recordings "$(DATA)")
	$(VENV)/push-ident experiment report

STREAMS ?= 10000
states: setup-dev  ## pushes under STREAMS=10000 random streams of joint states that lie: no command may break a limit (an hour)
	STREAMS=$(STREAMS) OMP_NUM_THREADS=1 $(VENV)/pytest -q -n 2 test/push_ident/pushing/test_corrupted_states.py

faults: setup-dev  ## the fault suite against a live cell (half an hour; root for full disks and the like), then docs/results/faults.md
	@mkdir -p log
	KILLS=20 FAULTS=docs/results/faults.json $(VENV)/pytest -vv --basetemp log/faults test/system/faults

# Three runs at once (CONVENTIONS.md, Tests): `alone` first, `live` at a lower priority, all others and lint in the time that is left, at the
# lowest, each in a session of its own: Linux schedules sessions against each other first, and niceness alone counts only within one.
# Only the files that have tests of a marker are loaded where they are few.
in_session = setsid nice -n $(1) bash -c 'echo $(1) 2>/dev/null >/proc/self/autogroup; $(2)'
with_marker = $$(grep -rl --include="test_*.py" "mark.$(1)" test)
test: setup-dev  ## lint, types and tests
	@mkdir -p log; \
	$(call in_session,19,export OMP_NUM_THREADS=1; \
	  $(MAKE) --no-print-directory lint >log/lint.log 2>&1 & \
	  $(VENV)/pytest -m "not alone and not live and not long and not release and not faults" -n 2 --dist loadfile --no-loadscope-reorder; tests=$$?; \
	  wait $$!; lint=$$?; exit $$((tests || lint))) \
	  >log/tests.log 2>&1 & others=$$!; \
	$(call in_session,10,$(VENV)/pytest -m "live and not alone and not long and not release" $(call with_marker,live)) >log/live.log 2>&1 & live=$$!; \
	trap 'kill -- -$$others -$$live 2>/dev/null' EXIT; \
	$(VENV)/pytest -m "alone and not long and not release" $(call with_marker,alone); status=$$?; \
	echo "Lint and the other tests (log/live.log, log/tests.log):"; \
	wait $$live || status=1; wait $$others || status=1; cat log/lint.log log/live.log log/tests.log; \
	exit $$status

test-long: setup-dev  ## the tests that `make test` leaves out since they take long
	OMP_NUM_THREADS=1 $(VENV)/pytest -m "long and not release"

test-release: FURTHER = $(DEV) pcd
test-release: setup  ## the tests that a release needs beside those: browser, wheel, strict site, notebook, SROS 2
	OMP_NUM_THREADS=1 $(VENV)/pytest -m release $(call with_marker,release)

test-oldest: setup-dev  ## part of the tests with the oldest packages that setup.py allows, numpy 1.26 among them (ten minutes)
	$(VENV)/python tools/test_oldest.py

lint: setup-dev  ## ruff and mypy
	$(VENV)/ruff check
	$(VENV)/ruff format --check
	$(VENV)/mypy

format: setup-dev  ## rewrite the sources as `make lint` wants them
	$(VENV)/ruff check --fix
	$(VENV)/ruff format

dist: setup-dev  ## wheel and sdist that need no ROS, in dist/
	rm -rf dist
	$(VENV)/python tools/make_dist.py

dist-check: dist  ## install that wheel from the index into an empty environment and use it (minutes)
	$(VENV)/python tools/check_dist.py

changelog: setup-dev  ## show what the fragments would add to CHANGELOG.md
	@$(VENV)/python -m towncrier build --draft --version unreleased

release: setup-dev  ## make release VERSION=1.2.3: the version everywhere, the fragments into CHANGELOG.md; commit and tag yourself
	$(VENV)/python tools/release.py "$(VERSION)"

clean:  ## build results; .venv stays
	rm -rf build dist install log out .mypy_cache .ruff_cache .pytest_cache .hypothesis

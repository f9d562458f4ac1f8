# Every target sets the checkout up first; a second set-up takes under 3 s.
SHELL := /bin/bash
PYTHON ?=
DEMO_OPTIONS ?=
IN_ENV := . ./env.sh &&
# Tests start hundreds of processes: each would compile the sources anew where containers forbid it.
PYTEST := PYTHONDONTWRITEBYTECODE= pytest
SIDE_BY_SIDE := -m "not soak" --dist loadfile --no-loadscope-reorder --max-worker-restart 0
# Of the checkout, its packages and its documents: `make check` runs these, `make test` all others.
CHECKED := tests/test_architecture.py tests/packages tests/documents
CODE := sim_pkg policy_pkg crash_coach_pkg ros_ws/src/crash_coach_common ros_ws/src/crash_coach_bringup \
    ros_ws/src/crash_coach_console tests benchmarks scripts examples
PAGE := ros_ws/src/crash_coach_console/crash_coach_console/web

.PHONY: help setup check test demo bench soak ray mlflow torchrl environments format lock clean

help: ## this list
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 10

setup: ## .venv, pinned packages, built ROS workspace
	@PYTHON="$(PYTHON)" $(if $(PYTHON),$(PYTHON),python3) scripts/setup.py

check: setup mlflow environments ## ruff, mypy, the laws of architecture and packages, the documents' commands
	$(IN_ENV) ruff format --check $(CODE) && ruff check $(CODE)
	$(IN_ENV) mypy sim_pkg/sim_pkg policy_pkg/policy_pkg crash_coach_pkg/crash_coach_pkg \
	    ros_ws/src/crash_coach_common/crash_coach_common \
	    ros_ws/src/crash_coach_bringup/crash_coach_bringup \
	    ros_ws/src/crash_coach_console/crash_coach_console scripts benchmarks
	$(IN_ENV) oxlint --quiet --deny-warnings $(PAGE)
	$(IN_ENV) $(PYTEST) $(SIDE_BY_SIDE) -n 2 -o faulthandler_timeout=1300 $(CHECKED)

test: setup ## the test suite (but for what `make check` runs), about 4 minutes on 2 cores
	$(IN_ENV) $(PYTEST) $(SIDE_BY_SIDE) -n 4 -o faulthandler_timeout=400 $(CHECKED:%=--ignore=%)

demo: setup ## train two teams, run them as ROS graphs, crash robots, read off the cost
	$(IN_ENV) crash-coach demo $(DEMO_OPTIONS)

bench: setup ## every benchmark, to runs/bench.json
	$(IN_ENV) python -m benchmarks

soak: setup ray mlflow torchrl environments ## fuzz, kill and latency tests at full size
	$(IN_ENV) $(PYTEST) -m soak --timeout 3600 -o faulthandler_timeout=3700

ray: setup ## the extra that `crash-coach sweep --engine ray` needs
	@.venv/bin/uv pip install --quiet --python .venv/bin/python -r requirements-ray.lock

mlflow: setup ## the extra that the logger mlflow needs
	@.venv/bin/uv pip install --quiet --python .venv/bin/python -r requirements-mlflow.lock

torchrl: setup ## the extra that examples/qmix_in_torchrl.py needs
	@.venv/bin/uv pip install --quiet --python .venv/bin/python -r requirements-torchrl.lock

environments: setup ## PettingZoo environments of others that the documents train on
	@.venv/bin/uv pip install --quiet --python .venv/bin/python -r requirements-environments.lock

format: setup ## put the code in its format
	$(IN_ENV) ruff format $(CODE) && ruff check --fix $(CODE)

lock: setup ## requirements.in -> requirements.lock, and the extras'
	.venv/bin/uv pip compile --quiet --universal --no-header --python-version 3.11 \
	    requirements.in -o requirements.lock
	.venv/bin/uv pip compile --quiet --universal --no-header --python-version 3.11 \
	    -c requirements.lock requirements-ray.in -o requirements-ray.lock
	.venv/bin/uv pip compile --quiet --universal --no-header --python-version 3.11 \
	    -c requirements.lock -c requirements-ray.lock requirements-mlflow.in -o requirements-mlflow.lock
	.venv/bin/uv pip compile --quiet --universal --no-header --python-version 3.11 \
	    -c requirements.lock -c requirements-mlflow.lock requirements-torchrl.in -o requirements-torchrl.lock
	.venv/bin/uv pip compile --quiet --universal --no-header --python-version 3.11 \
	    -c requirements.lock requirements-environments.in -o requirements-environments.lock

clean: ## remove what set-up and builds left (runs/ stays)
	rm -rf .venv ros_ws/build ros_ws/install ros_ws/log

# Everything a newcomer types: `make run` and `make test`. The rest is for those who stay.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
QUICK := not slow and not hardware and not browser
WINDOW_PACKAGES := libvulkan1 mesa-vulkan-drivers
TEST_PACKAGES := libopenni2-0 libopenni2-dev g++ $(WINDOW_PACKAGES) xvfb x11-utils libfaketime fish

.DEFAULT_GOAL := help
.PHONY: help typing run test test-browser test-lowest test-slow fuzz lint format system-packages recordings pictures wheel wheel-check docs hooks clean

help: ## Show this list
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-16s %s\n", $$1, $$2}'

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed; name it with: make PYTHON=python3.12")'
	@echo "Making the environment in $(VENV) ..."
	@$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	@echo "Installing selective-depth and what it needs (a minute or two the first time) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(VENV)/.tests-installed: pyproject.toml $(VENV)/.installed
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test,lint]'
	@touch $@

run: $(VENV)/.installed ## Replay the bundled recording: a viewer, or files where there is no display
	@[ -z "$$DISPLAY$$WAYLAND_DISPLAY" ] || .ci/system-packages $(WINDOW_PACKAGES) || echo "Going on without: where there is no graphics driver, the run is saved to a file."
	@$(BIN)/selective-depth replay --budget 0.05 --rounds 4

test: $(VENV)/.tests-installed ## Run the whole suite (the long forms: make test-slow)
	@.ci/system-packages $(TEST_PACKAGES) || echo "Going on without: the tests that need them are skipped."
	@$(BIN)/python -m pytest -m "$(QUICK)"

SMOKE := tests/drivers/test_frame.py tests/drivers/bag tests/selectors/test_seeds.py tests/selectors/test_quality.py tests/app/test_selecting.py tests/app/test_memory.py
test-lowest: ## Run the suite's smoke part on the oldest versions that are allowed
	@$(PYTHON) -m venv --clear .venv/lowest
	@.ci/lowest > .venv/lowest/constraints.txt
	@.venv/lowest/bin/pip install --quiet --disable-pip-version-check --constraint .venv/lowest/constraints.txt '.[test]'
	@NUMBA_CACHE_DIR=.venv/lowest/kernels .venv/lowest/bin/python -m pytest -m "$(QUICK)" $(SMOKE)

test-browser: $(VENV)/.tests-installed ## Drive the demo page in a real Chromium; pictures go to out/browser
	@.ci/system-packages chromium
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[browser]'
	@$(BIN)/python -m pytest -m browser

test-slow: $(VENV)/.tests-installed ## Run the long forms: fuzzing, soak, hundreds of cycles
	@.ci/system-packages $(TEST_PACKAGES)
	@$(BIN)/python -m pytest -m slow

typing: # the three folders as one package, for tools that read code without importing it
	@mkdir -p .typing/selective_depth
	@for room in app drivers selectors; do ln -sfn ../../$$room .typing/selective_depth/$$room; done

lint: $(VENV)/.tests-installed typing ## Check style, types and the import contract
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@PYTHONPATH=.typing $(BIN)/lint-imports --no-cache --no-logo

fuzz: $(VENV)/.tests-installed ## Damage every kind of input for 20 minutes each, all side by side
	@$(BIN)/python tests/fuzzing.py --minutes 20

docs: $(VENV)/.installed typing ## Make the documentation and the API reference: out/docs/index.html
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	@$(BIN)/mkdocs build --quiet --config-file .mkdocs.yml
	@echo "wrote out/docs/index.html"

hooks: $(VENV)/.tests-installed ## Check style and types at every commit, with pre-commit
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check pre-commit
	@$(BIN)/pre-commit install

format: $(VENV)/.tests-installed ## Put the code in its standard form
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

system-packages: ## Install what Debian has to give: OpenNI2, its headers, a software Vulkan, an X server for tests
	@.ci/system-packages $(TEST_PACKAGES)

recordings: $(VENV)/.tests-installed ## Make the recordings in recordings/ again
	@.ci/system-packages $(TEST_PACKAGES)
	@$(BIN)/python tests/make_recordings.py

pictures: $(VENV)/.installed ## Make the pictures of the README and the documentation again
	@.ci/system-packages libopenni2-0 $(WINDOW_PACKAGES)
	@mkdir -p out
	@$(BIN)/selective-depth replay --headless --save out/viewer.rrd --overwrite --budget 5% --rounds 4
	@$(BIN)/selective-depth screenshot out/viewer.rrd app/docs/pictures/viewer.webp
	@$(BIN)/selective-depth snapshot virtual:workstation virtual:ball virtual:firehose --frame 5 --budget 5% --rounds 8 --out app/docs/pictures/sheet.webp
	@$(BIN)/selective-depth evaluate "virtual:workstation?seed=7" --frames 1 --budget 0.05 --picture app/docs/pictures/evaluation.webp
	@$(BIN)/selective-depth evaluate "virtual:workstation?speed=0&frames=30" --over-time --budget 2% --picture app/docs/pictures/memory.webp
	@$(BIN)/python tests/make_virtual_docs.py

wheel: $(VENV)/.installed ## Build dist/*.whl
	@rm -rf dist build
	@$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .

wheel-check: wheel ## Install the wheel in an empty environment and replay its sample
	@rm -rf out/wheel && mkdir -p out/wheel
	@$(PYTHON) -m venv out/wheel/env
	@out/wheel/env/bin/python -m pip install --quiet --disable-pip-version-check dist/selective_depth-*.whl
	@cd out/wheel && env/bin/selective-depth replay --frames 3

clean: ## Remove everything that was made
	rm -rf $(VENV) .typing build dist out *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis

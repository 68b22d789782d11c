# Every target makes its own virtual environment when it is missing; nothing else has to be installed by hand.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SECONDS_ ?= 60
MINUTES ?= 20

.PHONY: demo test check studies bench chaos soak flood links docker-check lock clean

demo: $(VENV)/ready
	$(BIN)/trackmesh demo --seconds $(SECONDS_)

# Tests of real processes wait more than they work: these beside the rest of tests/network.
BESIDE := tests/hosts $(wildcard tests/network/test_units_*.py) tests/network/test_live_benchmark.py tests/network/test_tags_live.py

# Most of a first run is compilation: two halves at once, then the real processes on a machine that is quiet again.
test: check
	mkdir -p out
	$(BIN)/python -m pytest tests/services/fusion tests/services/cli > out/tests-fusion.txt 2>&1 & half=$$!; \
		$(BIN)/python -m pytest tests --ignore=tests/services/fusion --ignore=tests/services/cli --ignore=tests/network --ignore=tests/hosts; \
		rest=$$?; wait $$half; half=$$?; cat out/tests-fusion.txt; exit $$((rest | half))
	$(BIN)/python -m pytest $(BESIDE) > out/tests-beside.txt 2>&1 & half=$$!; \
		$(BIN)/python -m pytest tests/network $(addprefix --ignore=,$(BESIDE)); \
		rest=$$?; wait $$half; half=$$?; cat out/tests-beside.txt; exit $$((rest | half))

check: $(VENV)/ready
	$(BIN)/ruff check src tests benchmarks
	$(BIN)/ruff format --check src tests benchmarks
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

studies: $(VENV)/ready
	mkdir -p out/studies
	for name in tvimm manoeuvre association alpha-beta rfid emi; do \
		$(BIN)/trackmesh study $$name --json out/studies/$$name.json --plots out/studies || exit 1; done

bench: $(VENV)/ready
	$(BIN)/python -m benchmarks.run

# The image, built and run without a Docker daemon: as root, with buildah; BASE=local where there is no registry.
docker-check: $(VENV)/ready
	docker/check

# Ten minutes of a fault every five seconds; what grows in MINUTES; floods. Each leaves figures in out/.
chaos: $(VENV)/ready
	$(BIN)/python -m benchmarks.faults.chaos --out out/chaos

soak: $(VENV)/ready
	$(BIN)/python -m benchmarks.faults.soak --minutes $(MINUTES) --out out/soak

# As root: outages of large streams, 20 times; does a publisher ever stay cut off?
links: $(VENV)/ready
	$(BIN)/python -m tests.hosts.link_faults 1
	$(BIN)/python -m tests.hosts.link_faults 4 pour4 pourcut4 pour4 pourcut4 pour4

flood: $(VENV)/ready
	$(BIN)/python -m benchmarks.faults.flood --out out/flood

$(VENV)/ready: pyproject.toml requirements.lock
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "trackmesh needs Python 3.11 or newer")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --editable .
	touch $@

# The lock file pins every package of all extras, without naming an index.
lock: $(VENV)/ready
	$(BIN)/python -m pip install --quiet pip-tools
	$(BIN)/pip-compile --quiet --all-extras --strip-extras --no-emit-index-url --no-emit-trusted-host \
		--no-emit-find-links --no-header --no-annotate --unsafe-package trackmesh --output-file requirements.lock pyproject.toml

clean:
	rm -rf $(VENV) out build src/*.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis

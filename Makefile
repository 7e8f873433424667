# The most important commands are `make demo` and `make test`. Both set up .venv, need no root, and can be run again.

PYTHON ?= python3
BIN    := .venv/bin
CORE   := .venv/.core
READY  := .venv/.ready
# One thread is faster here: with several threads, small matrix products wait for each other.
export OPENBLAS_NUM_THREADS ?= 1
# Many tests start the program, which compiles itself each time without stored bytecode.
unexport PYTHONDONTWRITEBYTECODE

LIBRARY := hbr/kernels/_kernels.so

.NOTPARALLEL:
.PHONY: FORCE demo web test test-nightly test-kills test-web kernel-test fuzz lint docs hardware wheel bench lock clean test-servers debian-test help

help:
	@echo "make demo   enroll and find objects on the simulated bench, and write rig-demo/report.html"
	@echo "make web    show the simulated bench in a browser"
	@echo "make test   run the tests (three minutes on two idle cores)"
	@echo "make test-nightly  run all tests and those of make fuzz, with many more cases in each (20 to 60 minutes on two cores)"
	@echo "make test-kills  kill the program at a hundred points of its work, and check the stored data"
	@echo "make test-web   test the pages in a real browser, and attack the server"
	@echo "make kernel-test  run the program with Linux's real drivers in a virtual machine"
	@echo "make debian-test  install the program as on a Raspberry Pi, on a Debian in a container (root, 10 minutes)"
	@echo "make test-servers  test PostgreSQL, S3 and bluesky with real servers"
	@echo "make fuzz   attack every kind of input, 5 to 45 minutes (a part of test-nightly)"
	@echo "make lint   check formatting, lint, types, import contracts and licenses"
	@echo "make docs   build the documentation as a site in site/"
	@echo "make hardware  test the printed parts of the table, and write them as STL and STEP to build/hardware"
	@echo "make wheel  build wheels and sdist in dist/, compare them with a second build, and try the wheel in an empty environment"
	@echo "make bench  measure speeds, as ratios to other programs"
	@echo "make clean  remove the files that these commands made"

# This needs the packages of the program only, so that a new user waits less.
demo: $(CORE) $(LIBRARY)
	@$(BIN)/rig demo

web: $(READY) $(LIBRARY)
	@$(BIN)/rig serve --bench sim

test: $(READY) $(LIBRARY)
	@$(BIN)/python -m pytest -n auto --dist worksteal -rs

# This also selects the tests marked nightly. It leaves out the kernel tests and the installation on a Debian, which need
# the whole computer. With so many cases, one test may take minutes, so the limit that ends a test that hangs is longer.
test-nightly: $(READY) $(LIBRARY)
	@$(BIN)/python -m pytest -n auto --dist worksteal -rs -m "not kernel and not debian" --timeout 1800 --hypothesis-profile=nightly

# Kill the program a hundred times at different points of the commands and of the work on a catalog, or a thousand times with KILLS=90.
KILLS ?= 8
test-kills: $(READY) $(LIBRARY)
	@RIG_TEST_KILLS=$(KILLS) $(BIN)/python -m pytest -n auto --dist worksteal --timeout 3600 tests/faults/test_kill*.py

# This needs Debian's chromium. The packages of these tests are large, so only this target installs them.
test-web: $(READY) $(LIBRARY)
	@sh .ci/install .ci/browser.lock
	@$(BIN)/python -m pytest -rs -m "" --timeout 900 tests/browser

# This installs nothing. docs/how-to/test-with-real-drivers.md explains how to get the kernel (docs/decisions/0001).
KERNEL_FOLDER := $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/hbr-rig/kernel
kernel-test: export RIG_TEST_KERNEL ?= $(KERNEL_FOLDER)
kernel-test: $(READY) $(LIBRARY)
	@ls $(RIG_TEST_KERNEL) >/dev/null 2>&1 || echo "No kernel in $(RIG_TEST_KERNEL). To get Debian's own, without installing it:\n" \
	    "   mkdir -p $(KERNEL_FOLDER) && cd $(KERNEL_FOLDER) &&\n" \
	    "   apt-get download \$$(apt-cache depends linux-image-amd64 | sed -n 's/.*Depends: \(linux-image.*\)/\1/p')\n" \
	    "The virtual machine needs: sudo apt-get install --no-install-recommends qemu-system-x86 busybox-static kmod udev"
	@$(BIN)/python -m pytest -rs -m kernel -o faulthandler_timeout=300 tests/kernel

# This needs root and Debian's mmdebstrap and systemd-container. It makes a Debian in RIG_TEST_DEBIAN, once. For the one of a
# Raspberry Pi (RIG_TEST_MACHINE=aarch64) see docs/how-to/raspberry-pi.md.
debian-test: wheel
	@$(BIN)/python -m pytest -rs -m debian tests/deploy

# This needs Debian's postgresql. The packages of these tests are large, so only this target installs them.
test-servers: $(READY) $(LIBRARY)
	@sh .ci/install .ci/servers.lock
	@$(BIN)/python -m pytest -rs -m "" --timeout 600 tests/servers
	@RIG_TEST_CATALOG=postgres $(BIN)/python -m pytest -rs --timeout 300 tests/rig/catalog

fuzz: $(READY) $(LIBRARY)
	@$(BIN)/python -m pytest -n auto --dist worksteal -rs -m "" --hypothesis-profile=nightly tests/fuzz

lint: $(READY)
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports
	@$(BIN)/reuse lint --lines

# This uses no network: the theme loads no fonts, and links to other sites are not followed.
docs: $(READY)
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --clean
	@echo "Open site/index.html. With search: python3 -m http.server --directory site"

# The CAD packages are large, so only this target installs them. The pictures: python -m docs.hardware.pictures
hardware: $(READY)
	@sh .ci/install .ci/hardware.lock
	@$(BIN)/python -m pytest -rs -m "" --timeout 600 tests/hardware
	@$(BIN)/python -m docs.hardware.build build/hardware

wheel: $(READY)
	@sh .ci/wheel

bench: $(READY) $(LIBRARY)
	@for file in benchmarks/bench_*.py; do $(BIN)/python -m benchmarks.$$(basename $$file .py) || exit 1; done

# Locked versions with their hashes, for every platform and Python that the project supports. No address of an index is in
# the files, so that uv and pip install the same from any. requirements.lock is for development, .ci/core.lock for the program
# and its build; what runs outside of .venv has lock files of its own.
lock:
	uv pip compile --universal --python-version 3.11 --generate-hashes --extra dev --upgrade \
	    --no-header --no-emit-index-url pyproject.toml -o requirements.lock
	printf 'hatchling\neditables\n' | uv pip compile - pyproject.toml --constraint requirements.lock --universal --python-version 3.11 \
	    --generate-hashes --no-header --no-emit-index-url -o .ci/core.lock
	for tool in uv:uv 'setuptools poetry-core:backend' cyclonedx-bom:sbom 'playwright schemathesis axe-playwright-python:browser' \
	    'SQLAlchemy>=2.1 psycopg[binary] s3fs moto[server] bluesky bluesky-tiled-plugins tiled[client,server] pycolmap:servers'; do \
	    echo $${tool%:*} | tr ' ' '\n' | uv pip compile - --universal --python-version 3.11 \
	    --generate-hashes --upgrade --no-header --no-emit-index-url -o .ci/$${tool#*:}.lock; done
	echo build123d | uv pip compile - --constraint requirements.lock --universal --python-version 3.11 \
	    --generate-hashes --upgrade --no-header --no-emit-index-url -o .ci/hardware.lock

$(READY): requirements.lock pyproject.toml
	@sh .ci/setup "$(PYTHON)" requirements.lock
	@touch $(CORE) $@

$(CORE): .ci/core.lock pyproject.toml
	@sh .ci/setup "$(PYTHON)" .ci/core.lock
	@touch $@

# Compile the kernels if there is a C compiler. Without one, NumPy is used instead (docs/decisions/0021).
# The library contains a digest of its sources, which shows whether it is current. File times do not show a removed file.
$(LIBRARY): FORCE | $(CORE)
	@$(BIN)/python hbr/kernels/compile.py

FORCE:

clean:
	rm -rf $(LIBRARY) .venv .tools rig-demo site dist build .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

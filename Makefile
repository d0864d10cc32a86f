# Start with `make run` and `make test`; `make help` lists all targets.
# Needs the Rust toolchain, a C++ compiler, python3 with pip, and git. All targets share one profile.

SHELL := /bin/bash
PYTHON ?= python3
TARGET := $(or $(CARGO_TARGET_DIR),target)
GRAPH ?= configs/graphs/approaching-intersection.toml
REPORT ?= reports/approaching-intersection.json
HOST := $(shell uname -m)-unknown-linux-gnu

# A libtorch of the user wins over the fetched one; programs then find it by LD_LIBRARY_PATH.
ifneq ($(LIBTORCH),)
export LIBTORCH
export LD_LIBRARY_PATH := $(LIBTORCH)/lib$(if $(LD_LIBRARY_PATH),:$(LD_LIBRARY_PATH))
else ifneq ($(CARGO_TARGET_DIR),)
# Programs look for libtorch and ONNX Runtime next to ./target. With another target folder they need LD_LIBRARY_PATH.
export LD_LIBRARY_PATH := $(CURDIR)/.libtorch/lib:$(CURDIR)/.onnxruntime/lib$(if $(LD_LIBRARY_PATH),:$(LD_LIBRARY_PATH))
endif

.PHONY: help run build deb check-deb arm64-tools type-check-arm64 deb-arm64 check-arm64 results link check-link camera-rtsp camera-gst check-cameras test soak fuzz bench-peer lint sanitize miri sbom fmt libtorch onnxruntime

help: ## List the targets
	@grep -hE '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

# The programs of a run. `make run` leaves out what needs libtorch (training, evaluation, the window), the benchmarks,
# films and the bridge.
RUNNING := carff carff-launch carff-camera carff-encoder carff-forecaster carff-prober carff-renderer carff-controller

# The programs of a run, without optional parts. carff-features: `make build` then compiles none of their libraries again.
BUILD_RUNNING := cargo build --release --locked --bins --no-default-features $(addprefix -p ,$(RUNNING) carff-features)

run: onnxruntime ## Drive the shipped model through the intersection; show decisions, then write report, JSON and filmstrip
	$(BUILD_RUNNING)
	$(TARGET)/release/carff launch $(GRAPH) --report $(REPORT)

build: libtorch onnxruntime ## Build all programs
	cargo build --release --locked --workspace --bins

test: build ## Run all tests, including whole graphs of processes
	cargo test --release --locked --workspace --no-fail-fast

deb: build ## Build two Debian packages: for a vehicle (programs, checkpoints, configs, units), and what needs libtorch
	$(PYTHON) launch/packaging/build_deb.py $(TARGET)

check-deb: deb ## Install the packages here, drive, try to access a run as another user, purge them (as root)
	$(PYTHON) tests/scripts/check_deb.py $(TARGET)/carff_*.deb $(TARGET)/carff-lab_*.deb

# Cross-building for 64-bit Arm. Another compiler is given as ARM64_CC and ARM64_CXX.
ARM64 := aarch64-unknown-linux-gnu
ARM64_CC ?= aarch64-linux-gnu-gcc
ARM64_CXX ?= aarch64-linux-gnu-g++
ARM64_ENV := CC_aarch64_unknown_linux_gnu=$(ARM64_CC) CXX_aarch64_unknown_linux_gnu=$(ARM64_CXX) \
	CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=$(ARM64_CC)
ARM64_BUILD := --target $(ARM64) --target-dir $(TARGET)/arm64
# Crates whose tests run under emulation.
ARM64_TESTED := carff-messages carff-field carff-transport carff-decision

arm64-tools:
	@command -v $(ARM64_CC) > /dev/null && command -v $(ARM64_CXX) > /dev/null || { \
		echo "no compiler for 64-bit Arm: sudo apt-get install g++-aarch64-linux-gnu libc6-dev-arm64-cross" >&2; exit 1; }
	rustup target add $(ARM64)
	@$(PYTHON) launch/packaging/fetch_libraries.py onnxruntime --machine aarch64

# A part of .ci/run that needs no C compiler for the target. Only the field's tests depend on the processor.
type-check-arm64:
	cargo check --release --locked $(ARM64_BUILD) --no-default-features $(addprefix -p ,$(RUNNING))
	cargo check --release --locked $(ARM64_BUILD) --lib --tests -p carff-field

deb-arm64: arm64-tools ## Cross-build the Debian package of a vehicle for 64-bit Arm
	cargo build --release --locked --bins -p carff -p carff-launch
	$(ARM64_ENV) cargo build --release --locked --bins $(ARM64_BUILD) --no-default-features \
		--features carff/default,carff-launch/default $(addprefix -p ,$(RUNNING))
	$(PYTHON) launch/packaging/build_deb.py $(TARGET) --machine aarch64

check-arm64: arm64-tools onnxruntime ## Cross-build for 64-bit Arm; test and drive under emulation (needs qemu-user-static)
	$(PYTHON) tests/scripts/check_arm64.py --requirements
	$(BUILD_RUNNING)
	$(ARM64_ENV) $(BUILD_RUNNING) $(ARM64_BUILD)
	$(ARM64_ENV) $(PYTHON) tests/scripts/check_arm64.py $(TARGET) $(ARM64_TESTED)

# Checkpoint and seeds of the tables in docs/RESULTS.md.
CHECKPOINT ?= approaching-intersection
SEED ?= 7
EVAL = $(TARGET)/release/carff eval configs/checkpoints/$(CHECKPOINT) --out reports/results/$(CHECKPOINT)

results: build ## Make the tables of docs/RESULTS.md for CHECKPOINT (default approaching-intersection) in reports/results (hours)
	$(EVAL)/tables $(addprefix --only ,psnr encoder recall planning frequencies images) --seed $(SEED)
	$(EVAL)/trials --only trials --seed 29
	$(EVAL)/robustness --only robustness --free-poses 40 --free-drives 1000 --seed 71
	$(EVAL)/memory --only memory --free-drives 400 --seed 163
	$(EVAL)/localisation --only localisation --seed 7 --threads 1
	for rule in always-halt always-advance calibrated phantom peek look oracle; do \
		$(TARGET)/release/carff drive $(CHECKPOINT) --checkpoint configs/checkpoints/$(CHECKPOINT) --rule $$rule \
			--episodes $(or $(EPISODES),300) --seed 101 --set renderer.max_rate_hz=0.1 \
			--json reports/results/$(CHECKPOINT)/drive-$$rule.json || exit 1; done

link: ## Build carff-link, which forwards topics to another machine (optional; zenoh adds 300 crates)
	cargo build --release --locked --manifest-path services/link/Cargo.toml --target-dir $(TARGET)/link
	mkdir -p $(TARGET)/release
	cp $(TARGET)/link/release/carff-link $(TARGET)/release/

check-link: build link ## Test carff-link; then drive here, observe from another network, and cut the link (as root)
	cargo fmt --manifest-path services/link/Cargo.toml --check
	cargo test --release --locked --manifest-path services/link/Cargo.toml --target-dir $(TARGET)/link
	$(PYTHON) tests/scripts/check_link.py $(TARGET)/release

camera-rtsp: ## Build carff-camera-rtsp, the camera of RTSP network cameras (optional; adds 90 crates)
	cargo build --release --locked --manifest-path services/camera-rtsp/Cargo.toml --target-dir $(TARGET)/cameras
	mkdir -p $(TARGET)/release
	cp $(TARGET)/cameras/release/carff-camera-rtsp $(TARGET)/release/

camera-gst: ## Build carff-camera-gst, the camera of GStreamer pipelines (optional; needs GStreamer's development packages)
	cargo build --release --locked --manifest-path services/camera-gst/Cargo.toml --target-dir $(TARGET)/cameras
	mkdir -p $(TARGET)/release
	cp $(TARGET)/cameras/release/carff-camera-gst $(TARGET)/release/

check-cameras: build camera-rtsp camera-gst ## Test both optional cameras on pipelines and on an RTSP server of this machine
	cargo fmt --manifest-path services/camera-rtsp/Cargo.toml --check
	cargo fmt --manifest-path services/camera-gst/Cargo.toml --check
	cargo test --release --locked --manifest-path services/camera-rtsp/Cargo.toml --target-dir $(TARGET)/cameras
	$(PYTHON) tests/scripts/check_cameras.py $(TARGET)/release

bench-peer: ## Build the peer with which `carff bench ipc` also measures zenoh (optional; adds 300 crates)
	cargo build --release --locked --manifest-path tests/zenoh-peer/Cargo.toml --target-dir $(TARGET)/zenoh-peer
	mkdir -p $(TARGET)/release
	cp $(TARGET)/zenoh-peer/release/carff-zenoh-peer $(TARGET)/release/

lint: libtorch ## Check format and lints
	cargo fmt --all --check
	cargo clippy --release --locked --workspace --all-targets -- -D warnings

sanitize: libtorch ## Run the tests around `unsafe` under the address sanitizer (needs a nightly toolchain)
	RUSTFLAGS=-Zsanitizer=address LD_LIBRARY_PATH=$(CURDIR)/.libtorch/lib cargo +nightly test --locked --lib --tests \
		--target $(HOST) --target-dir $(TARGET)/sanitize \
		-p carff-field -p carff-messages -p carff-networks -p carff-transport

miri: ## Run the kernels of the field (portable path) and the messages' tests under Miri (nightly with miri and rust-src)
	cargo +nightly miri test --locked --lib --target-dir $(TARGET)/miri -p carff-field -- dispatch::
	cargo +nightly miri test --locked --lib --target-dir $(TARGET)/miri -p carff-messages

# Instrumentation for libFuzzer.
FUZZ_FLAGS := --cfg fuzzing -Ccodegen-units=1 -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
	-Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
	-Cllvm-args=-sanitizer-coverage-trace-compares
READERS := messages graph scenario soak training dataset import png planning manifest weights recording bag calibration run-record
FUZZ := $(TARGET)/fuzz

fuzz: libtorch ## Feed each of READERS (default: all) with RUNS inputs (default 1000000), guided by coverage (nightly)
	RUSTFLAGS="$(FUZZ_FLAGS)" cargo +nightly build --release --locked --manifest-path tests/fuzz/Cargo.toml \
		--target $(HOST) --target-dir $(FUZZ)
	for reader in $(READERS); do \
		mkdir -p $(FUZZ)/corpus/$$reader $(FUZZ)/seeds/$$reader $(FUZZ)/found/$$reader tests/readers/corpus/$$reader && \
		CARFF_READER=$$reader CARFF_SEEDS=$(FUZZ)/seeds/$$reader TMPDIR=/dev/shm \
			LD_LIBRARY_PATH=$(CURDIR)/.libtorch/lib $(FUZZ)/$(HOST)/release/carff-fuzz \
			-runs=$(or $(RUNS),1000000) -max_len=65536 -timeout=20 -rss_limit_mb=4096 -malloc_limit_mb=1024 \
			-print_final_stats=1 -artifact_prefix=$(FUZZ)/found/$$reader/ \
			$(FUZZ)/corpus/$$reader $(FUZZ)/seeds/$$reader tests/readers/corpus/$$reader \
			2> $(FUZZ)/$$reader.log || { tail -40 $(FUZZ)/$$reader.log; exit 1; }; \
		printf '%-11s' $$reader; grep -h "stat::number_of_executed_units" $(FUZZ)/$$reader.log; done

soak: build ## Run the shipped graph for MINUTES (default 10) with SEED (default 1) under every kind of fault
	$(TARGET)/release/carff soak configs/soak/all.toml --minutes $(or $(MINUTES),10) --seed $(or $(SEED),1) --json reports/soak.json

sbom: ## Write the bill of materials of the programs, as CycloneDX JSON (needs cargo-cyclonedx)
	$(PYTHON) launch/packaging/build_sbom.py $(TARGET)/carff.cdx.json

fmt: ## Format all Rust sources
	cargo fmt --all

libtorch: ## Fetch libtorch once (your own LIBTORCH wins)
	@$(PYTHON) launch/packaging/fetch_libraries.py libtorch

onnxruntime: ## Fetch ONNX Runtime once (your own ORT_DYLIB_PATH wins)
	@$(PYTHON) launch/packaging/fetch_libraries.py onnxruntime

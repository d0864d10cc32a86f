# The whole program in a few words: `make run`, `make test`. `make help` lists all.
# Needs: the Rust toolchain, a C++ compiler, python3 with pip, git. All is built in one profile, so that nothing is
# built twice.

SHELL := /bin/bash
PYTHON ?= python3
TARGET := $(or $(CARGO_TARGET_DIR),target)
GRAPH ?= configs/graphs/approaching-intersection.toml
REPORT ?= reports/approaching-intersection.json

# A libtorch of the user's own wins over the fetched one; programs then find it by LD_LIBRARY_PATH.
ifneq ($(LIBTORCH),)
export LIBTORCH
export LD_LIBRARY_PATH := $(LIBTORCH)/lib$(if $(LD_LIBRARY_PATH),:$(LD_LIBRARY_PATH))
else ifneq ($(CARGO_TARGET_DIR),)
# The built programs look beside ./target; with another target folder they are told.
export LD_LIBRARY_PATH := $(CURDIR)/.libtorch/lib$(if $(LD_LIBRARY_PATH),:$(LD_LIBRARY_PATH))
endif

.PHONY: help run build test soak bench-peer lint sanitize fmt libtorch

help: ## List the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

run: build ## Drive the shipped model through the intersection: decisions live, then report, JSON and filmstrip
	$(TARGET)/release/carff launch $(GRAPH) --report $(REPORT)

build: libtorch ## Build all programs
	cargo build --release --locked --workspace --bins

test: build ## Run all tests, whole graphs of processes among them
	cargo test --release --locked --workspace

bench-peer: ## Build the program by which `carff bench ipc` measures zenoh as well (300 crates more; nothing else needs it)
	cargo build --release --locked --manifest-path tests/zenoh-peer/Cargo.toml --target-dir $(TARGET)/zenoh-peer
	mkdir -p $(TARGET)/release
	cp $(TARGET)/zenoh-peer/release/carff-zenoh-peer $(TARGET)/release/

lint: libtorch ## Check format and lints
	cargo fmt --all --check
	cargo clippy --release --locked --workspace --all-targets -- -D warnings

sanitize: libtorch ## Run the tests around `unsafe` under the address sanitizer (needs a nightly toolchain)
	RUSTFLAGS=-Zsanitizer=address LD_LIBRARY_PATH=$(CURDIR)/.libtorch/lib cargo +nightly test --locked --lib --tests \
		--target x86_64-unknown-linux-gnu --target-dir $(TARGET)/sanitize \
		-p carff-field -p carff-messages -p carff-models -p carff-transport

soak: build ## Soak the shipped graph for MINUTES (default 10) with SEED (default 1) under every kind of fault
	$(TARGET)/release/carff soak configs/soak/all.toml --minutes $(or $(MINUTES),10) --seed $(or $(SEED),1) --json reports/soak.json

fmt: ## Format
	cargo fmt --all

libtorch: ## Fetch libtorch once (a LIBTORCH of your own wins)
	@$(PYTHON) launch/fetch_libtorch.py

# `make run` and `make test` install what they need and say so.
SHELL := /bin/bash
SUDO := $(if $(filter 0,$(shell id -u)),,sudo)
comma := ,
# install PACKAGE-IF-MISSING: $(call need,test command,packages)
need = @$(1) >/dev/null 2>&1 || { echo "Installing $(2) (Debian packages)"; $(SUDO) apt-get update -qq && $(SUDO) env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $(2) >/dev/null; }

# A Python environment in target/NAME with what a file requires: $(call venv,NAME,FILE)
venv = @cmp -s $(2) target/$(1)/installed.txt || { echo "Installing $(1)"; python3 -m venv --clear target/$(1) && \
	target/$(1)/bin/pip install --quiet --requirement $(2) && cp $(2) target/$(1)/installed.txt; }

.PHONY: run test build setup setup-test

run: setup
	@echo "Building (a first build takes some minutes)"
	@cargo build --release --locked
	@echo "Starting on the built-in simulator; stop with Ctrl-C"
	@exec target/release/oapwatch run

.PHONY: run-fleet
# Three simulated access points, a NATS server and the hub, on this machine.
run-fleet: build
	$(call need,command -v nats-server,nats-server)
	@deploy/run-fleet.sh

build: setup
	cargo build --release --locked

# Tests share the program's build. Where CI is set nothing is skipped: what a test needs is installed first, and this crate (not its
# dependencies) has overflow checks and debug assertions, in the camera's test and the package too, so that it is built once.
CHECKED := $(if $(CI),--config 'profile.release.package.oapwatch.debug-assertions=true' --config 'profile.release.package.oapwatch.overflow-checks=true')
test: setup $(if $(CI),setup-test,test-skips)
	cargo test --release --locked $(CHECKED)

.PHONY: test-skips
test-skips:
	@command -v chromium chromium-browser google-chrome >/dev/null || echo "Skipping the page in a browser: Chromium is missing (make setup-test installs it)"
	@test -x /usr/sbin/rsyslogd -a -x /usr/bin/prometheus-alertmanager || echo "Skipping other systems: rsyslog or prometheus-alertmanager is missing (make setup-test installs them)"
	@test -x target/pymavlink/bin/python || echo "Skipping telemetry sent by pymavlink: it is missing (make setup-test installs it)"
	@command -v nats-server >/dev/null || echo "Skipping the fleet with a real server: nats-server is missing (make setup-test installs it)"
	@command -v mosquitto_sub >/dev/null || echo "Skipping MQTT clients of the fleet: mosquitto-clients is missing (make setup-test installs it)"
	@test -x target/systems/bin/taky || echo "Skipping TAK and SAPIENT: taky or sapient-pydantic is missing (make setup-test installs them)"
	@test -x target/schemathesis/bin/schemathesis || echo "Skipping requests made from the API's description: schemathesis is missing (make setup-test installs it)"

setup:
	@command -v cargo >/dev/null || { echo "Rust is missing: install it from https://rustup.rs"; exit 1; }
	$(call need,command -v cc,build-essential)

setup-test:
	$(call need,command -v chromium,chromium chromium-driver)
	$(call need,test -x /usr/sbin/rsyslogd -a -e /usr/lib/$(shell uname -m)-linux-gnu/rsyslog/lmnsd_gtls.so -a -x /usr/bin/prometheus-alertmanager,rsyslog rsyslog-gnutls prometheus-alertmanager)
	$(call need,sh -c 'command -v nats-server && command -v mosquitto_sub',nats-server mosquitto-clients)
	$(call need,python3 -c 'import ensurepip$(comma) venv',python3-venv)
	$(call venv,schemathesis,tests/schemathesis/requirements.txt)
	$(call venv,pymavlink,tests/platform/requirements.txt)
	$(call venv,systems,tests/notify/requirements.txt)

.PHONY: test-licences
# A debug build of cargo-deny takes half the time of a release build and checks as fast.
test-licences: setup
	@command -v cargo-deny >/dev/null || { echo "Installing cargo-deny"; cargo install --debug --locked --quiet cargo-deny; }
	cargo deny --locked check licenses bans sources
	@cargo metadata --locked --format-version 1 --manifest-path fuzz/Cargo.toml >/dev/null

.PHONY: deb
# The Debian package, target/oapwatch.deb, linted and measured. PROFILE=release builds what `make run` has built already.
PROFILE ?= dist
deb: setup
	$(call need,sh -c 'command -v lintian && command -v python3 && command -v systemd-analyze',lintian python3-minimal systemd)
	@# Earlier than 3.8, it takes the options of one unit for all.
	@case "$$(cargo deb --version 2>/dev/null)" in 3.[89].*|3.[1-9][0-9]*|[4-9]*) ;; *) cargo install --locked cargo-deb ;; esac
	cargo build --profile $(PROFILE) --locked $(if $(filter release,$(PROFILE)),$(CHECKED))
	rm -rf target/man target/completions && mkdir -p target/completions
	target/$(PROFILE)/oapwatch man target/man
	target/$(PROFILE)/oapwatch completions bash > target/completions/oapwatch.bash
	target/$(PROFILE)/oapwatch completions zsh > target/completions/_oapwatch
	target/$(PROFILE)/oapwatch completions fish > target/completions/oapwatch.fish
	cargo deb --no-build --profile $(PROFILE) --output target/oapwatch.deb
	tests/deploy/package.py target/oapwatch.deb

.PHONY: test-v4l2
# Capture from a real V4L2 device (the kernel's virtual camera) in a virtual machine.
test-v4l2: setup
	$(call need,sh -c 'command -v qemu-system-x86_64 && command -v busybox && command -v depmod && command -v cpio && command -v v4l2-ctl && command -v xz',qemu-system-x86 busybox-static kmod cpio v4l-utils xz-utils)
	cargo build --release --locked $(CHECKED) --bin oapwatch --example v4l2_guest
	tests/v4l2/run.sh target/release/examples/v4l2_guest target/release/oapwatch

.PHONY: test-deploy
# The package in a virtual machine with systemd: installed, attacked, upgraded, purged. Needs root for mmdebstrap.
test-deploy:
	$(call need,sh -c 'command -v qemu-system-x86_64 && command -v busybox && command -v depmod && command -v cpio && command -v mmdebstrap && command -v mksquashfs && command -v xz',qemu-system-x86 busybox-static kmod cpio mmdebstrap squashfs-tools xz-utils)
	@test -f target/oapwatch.deb || $(MAKE) deb
	tests/deploy/run.sh

.PHONY: test-power-cuts
# Twenty power cuts of a virtual machine while alerts flow: what the log or a receiver heard is in the journal. Not in CI: minutes.
# CUTS="--cuts 5 --seed 2" and the like go on to it.
CUTS ?=
test-power-cuts: build
	$(call need,sh -c 'command -v qemu-system-x86_64 && command -v busybox && command -v depmod && command -v cpio && command -v xz && command -v mke2fs && command -v python3',qemu-system-x86 busybox-static kmod cpio xz-utils e2fsprogs python3-minimal)
	tests/power_cuts/run.sh target/release/oapwatch $(CUTS)

.PHONY: soak
# Whether memory, file descriptors or threads grow, over SOAK_S seconds of 40 times the usual pace. Not in CI: it takes its time.
# SOAK="--frames 1000000 --rate 500 --estimator network --samples FILE" and the like go on to it; soak_picture.py draws the samples.
SOAK_S ?= 600
SOAK ?=
soak: build
	$(call need,command -v python3,python3-minimal)
	tests/deploy/soak.py target/release/oapwatch --seconds $(SOAK_S) $(SOAK)

.PHONY: siege
# Floods of requests and of claims, slow and endless clients, a thousand viewers, a gigabyte of garbage: what they cost the monitor. Not in CI: minutes.
siege: build
	OAPWATCH_PROGRAM=$(CURDIR)/target/release/oapwatch cargo test --release --locked --test daemon -- --ignored --nocapture --test-threads 1 siege

.PHONY: fleet-measured
# Kills while alerts flow, an alert's way to the hub, a thousand access points on one hub, frames while the server is gone: what
# docs/fleet.md says of them. Not in CI: minutes. FLEET=kills and the like runs one of them.
FLEET ?=
fleet-measured: build
	$(call need,command -v nats-server,nats-server)
	OAPWATCH_PROGRAM=$(CURDIR)/target/release/oapwatch cargo test --release --locked --test daemon -- --ignored --nocapture --test-threads 1 fleet_measured::$(FLEET)

.PHONY: overload
# How old results grow under ten times the frames that the daemon can handle.
overload: build
	$(call need,command -v python3,python3-minimal)
	tests/deploy/overload.py target/release/oapwatch

.PHONY: aarch64 check-aarch64 test-aarch64
aarch64: VERB := build
check-aarch64: VERB := check
aarch64 check-aarch64: setup
	$(call need,command -v aarch64-linux-gnu-gcc,gcc-aarch64-linux-gnu libc6-dev-arm64-cross)
	rustup target add aarch64-unknown-linux-gnu
	CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc \
		cargo $(VERB) --release --locked --target aarch64-unknown-linux-gnu --target-dir target/cross --bin oapwatch

# The program for the usual computer of a UAV, target/cross/aarch64-unknown-linux-gnu/release/oapwatch, and the same run under
# emulation beside the one for this machine. Not in CI: it takes every dependency once more. check-aarch64 only compiles.
test-aarch64: aarch64 build
	$(call need,command -v qemu-aarch64-static,qemu-user-static)
	tests/deploy/aarch64.py target/release/oapwatch target/cross/aarch64-unknown-linux-gnu/release/oapwatch

.PHONY: fuzz
# Coverage-guided fuzzing, FUZZ_S seconds a target: libFuzzer with the address sanitizer, which a stable toolchain has too when told
# that it is another one. Not in CI: it takes every dependency once more.
FUZZ_S ?= 60
FUZZ := npy config calibration scene claims mavlink ulg terrain http v4l2 locate onnx
HOST = $(shell rustc -vV | sed -n 's/^host: //p')
SANITIZED = RUSTC_BOOTSTRAP=1 RUSTFLAGS="-Zsanitizer=address" RUSTC_WRAPPER=$(CURDIR)/fuzz/rustc.sh
fuzz: setup
	$(call need,command -v g++,g++)
	$(SANITIZED) cargo build --release --locked --manifest-path fuzz/Cargo.toml --target-dir target/fuzz --target $(HOST)
	# A socket that is closed while it is written to is an error here as in the program, not the end.
	cd fuzz && trap '' PIPE && for each in $(FUZZ); do \
		mkdir -p corpus/$$each artifacts && \
		../target/fuzz/$(HOST)/release/$$each corpus/$$each $$(test $$each = onnx && echo ../config/models || echo seeds/$$each) \
			-artifact_prefix=artifacts/$$each- -max_total_time=$(FUZZ_S) -timeout=20 -rss_limit_mb=4096 -print_final_stats=1 || exit 1; done

.PHONY: test-v4l2-sanitized
# What test-v4l2 does, every read and write of memory checked. Three scenarios want more speed than that leaves.
UNHURRIED := bit-exact devices dropped error failed fatal disconnect unplug starvation stamps busy format gain exposure
test-v4l2-sanitized: build
	$(SANITIZED) cargo build --release --locked --manifest-path fuzz/Cargo.toml --target-dir target/fuzz --target $(HOST) --bin v4l2_guest
	MEMORY_MB=2048 tests/v4l2/run.sh target/fuzz/$(HOST)/release/v4l2_guest target/release/oapwatch $(UNHURRIED)

.PHONY: stability
# docs/stability/cases.md: every hard case, a thousand frames of each where a frame is cheap; minutes on a machine that does nothing else.
STABILITY := Sensors:1000 Emitters:1000 Invariance:200 Frames:5 Ladder:3 Optics:1 Assignment:1 Verdicts:1
stability: build
	printf '# Hard cases\n\nCondition and steps are the largest of any frame.\n' > docs/stability/cases.md
	for each in $(STABILITY); do \
		target/release/oapwatch stability --only "$${each%:*}" --frames "$${each#*:}" | grep -v '^All ' >> docs/stability/cases.md; done

.PHONY: native
# What a build for this very processor gains over the packaged one. Takes every dependency once more.
native: build
	RUSTFLAGS="-C target-cpu=native" cargo build --release --locked --bin oapwatch --target-dir target/native
	benches/native.py target/release/oapwatch target/native/release/oapwatch

.PHONY: tradeoff
# docs/tradeoff: what accuracy costs in time. Some minutes on a machine that does nothing else.
tradeoff: build
	rm -f docs/tradeoff/tradeoff.json
	target/release/oapwatch tradeoff --frames 200 --out docs/tradeoff
	target/release/oapwatch tradeoff --exposure --out docs/tradeoff

#!/usr/bin/env bash
# A fleet on one machine: a NATS server, three simulated access points and the hub. Ends with Ctrl-C.
set -euo pipefail
cd "$(dirname "$0")/.."
program=$PWD/target/release/oapwatch
scenes=$PWD/config/scenes
work=$(mktemp -d)
trap 'kill $(jobs -p) 2>/dev/null; rm -rf "$work"' EXIT

nats-server -js -a 127.0.0.1 -p 4222 -sd "$work/nats" 2>"$work/nats.log" &
port=8790
for station in ap1:builtin ap2:eavesdropper ap3:windy; do
	name=${station%:*}
	mkdir -p "$work/$name"
	# Users of its own: of one name at two places each would be an attack.
	sed "s/\"u-/\"$name-u-/g" "$scenes/${station#*:}.toml" >"$work/$name/scene.toml"
	cat >"$work/$name/oapwatch.toml" <<-TOML
		[source]
		kind = "simulator"
		scene = "scene.toml"
		[journal]
		path = "journal.db"
		[fleet]
		url = "nats://127.0.0.1:4222"
		site = "harbour"
		station = "$name"
		[log]
		level = "warn"
	TOML
	"$program" run --config "$work/$name/oapwatch.toml" --listen "127.0.0.1:$port" &
	echo "$name: http://127.0.0.1:$port"
	port=$((port + 1))
done
cat >"$work/hub.toml" <<-TOML
	[fleet]
	url = "nats://127.0.0.1:4222"
	[journal]
	path = "hub.db"
TOML
echo "hub: http://127.0.0.1:8787"
"$program" fleet --config "$work/hub.toml"

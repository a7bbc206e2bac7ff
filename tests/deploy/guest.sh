#!/bin/bash
# Runs inside the VM as root: the package as an operator uses it. Every check has a name and can fail.
export PATH=/usr/sbin:/usr/bin:/sbin:/bin LC_ALL=C DEBIAN_FRONTEND=noninteractive
api=http://127.0.0.1:8787
config=/etc/oapwatch/oapwatch.toml
vivid=/sys/bus/platform/drivers/vivid
n=0
check() { # check "what" command...
    n=$((n + 1))
    local what=$1 began=$SECONDS
    shift
    if "$@" >/tmp/out 2>&1; then echo "ok $n - $what ($((SECONDS - began)) s)"; else
        echo "not ok $n - $what ($((SECONDS - began)) s)"
        { tail -n 3 /tmp/out; journalctl -u oapwatch --no-pager -o cat -n 8; } 2>&1 | cut -c1-300 | sed 's/^/    # /'
    fi
}
within() { # within SECONDS command...
    local end=$((SECONDS + $1))
    shift
    until "$@"; do
        [ $SECONDS -lt $end ] || return 1
        sleep 0.3
    done
}
finish() { # the machine ends with QEMU's exit code (16 << 1) | 1
    python3 -c 'import os; f = os.open("/dev/port", os.O_WRONLY); os.lseek(f, 0xF4, 0); os.write(f, bytes([16]))'
}

ready() { curl -fsS -m 5 $api/readyz; }
pid() { systemctl show -P MainPID oapwatch; }
same() { [ "$(pid)" = "$1" ] && ready; }
restarted() { [ "$(pid)" != 0 ] && [ "$(pid)" != "$1" ] && ready; }
alerts() { curl -fsS -m 5 "$api/v1/alerts?limit=100"; }
ids() { (set -o pipefail && alerts | grep -o '"id":"[^"]*"' | cut -d'"' -f4); } # of the newest hundred
has_alert() { alerts | grep -q unclaimed_emitter; }
kept() { # every alert of the list $1 is still known, however many came since
    [ -n "$1" ] || { echo "no alert was known before" && return 1; }
    # shellcheck disable=SC2046,SC2086
    curl -fsS -m 60 --fail-early $(printf "$api/v1/alerts/%s " $1) >/dev/null
}
metric() { # metric NAME: its value
    curl -fsS -m 5 $api/metrics | sed -n "s/^$1 //p"
}
is() { [ "$(metric "$1")" = "$2" ]; }
more() { # more METRIC THAN
    [ "$(metric "$1")" -gt "$2" ]
}
grows() { # grows METRIC
    local before
    before=$(metric "$1")
    [ -n "$before" ] && within 30 more "$1" "$before"
}
delivered() { grep -q "$1" /run/received; }
owes_nothing() { curl -fsS -m 5 $api/metrics | grep -q '^oapwatch_webhook_queued{.*} 0$'; }
gave_nothing_up() { curl -fsS -m 5 $api/metrics | grep -q '^oapwatch_webhook_dead_letters{.*} 0$'; }
result() { [ "$(systemctl show -P Result oapwatch)" = "$1" ]; }
status() { systemctl show -P StatusText oapwatch | grep -E 'frames/s, .* open alerts'; }

python3 /receiver.py &

check "apt installs the package" apt-get install -qq -y --no-install-recommends /oapwatch.deb
check "the service is ready as shipped" within 60 ready
if ! ready >/dev/null 2>&1; then
    systemctl status oapwatch --no-pager --full
    finish
fi
check "it is enabled for the next boot" systemctl is-enabled oapwatch
check "its status line says what it does" within 60 status
check "the eavesdropper is alerted" within 90 has_alert
check "it does not run as root" bash -c '[ "$(stat -c %u /proc/'"$(pid)"')" != 0 ]'
check "memory stays below 100 MB" bash -c 'awk "/VmRSS/ { print; exit \$2 > 100000 }" /proc/'"$(pid)"'/status'

# The default estimator is slow where floating point is emulated.
sed -i 's/^# name = "ml".*/name = "subpixel-peak"/' $config
printf 'whsec_%s\n' "$(head -c 32 /dev/urandom | base64)" >/etc/oapwatch/credentials/webhook
cat >>$config <<'C'

[[webhook]]
url = "http://127.0.0.1:9100/hook"
secret_file = "$CREDENTIALS_DIRECTORY/oapwatch_webhook"
C
check "it starts with a webhook whose secret is a credential" systemctl restart oapwatch
check "an alert is delivered to the receiver" within 90 delivered alert.raised

before=$(within 60 ids)
old=$(pid)
kill -9 "$old"
check "kill -9 is followed by a restart" within 60 restarted "$old"
check "kill -9 loses no alert" within 60 kept "$before"

mkdir -p /etc/systemd/system/oapwatch.service.d
printf '[Service]\nWatchdogSec=5\n' >/etc/systemd/system/oapwatch.service.d/watchdog.conf
systemctl daemon-reload
systemctl restart oapwatch
old=$(pid)
kill -STOP "$old"
check "the watchdog restarts a frozen process" within 60 restarted "$old"
rm -r /etc/systemd/system/oapwatch.service.d
systemctl daemon-reload
systemctl restart oapwatch

old=$(pid)
check "reload keeps the process" bash -c 'systemctl reload oapwatch && sleep 1'
check "and it goes on" within 30 same "$old"
cp $config /tmp/good
echo 'nonsense = 1' >>$config
systemctl reload oapwatch
sleep 1
check "a bad config changes nothing on reload" within 30 same "$old"
check "and is refused by name at a restart" bash -c "oapwatch check $config; [ \$? = 64 ]"
cp /tmp/good $config

date -s '+1 hour' >/dev/null
sleep 2
check "the clock stepped an hour forward" within 30 same "$old"
check "frames go on after it" grows oapwatch_frames_captured_total
date -s '-2 hours' >/dev/null
sleep 2
check "the clock stepped two hours back" within 30 same "$old"
check "frames go on after that" grows oapwatch_frames_captured_total

systemctl restart oapwatch
check "the journal is writable" within 60 is oapwatch_journal_writable 1
dd if=/dev/zero of=/var/tmp/fill bs=1M 2>/dev/null
dd if=/dev/zero of=/var/tmp/rest bs=4k 2>/dev/null
check "a full disk is told by the metric" within 120 is oapwatch_journal_writable 0
check "monitoring goes on with a full disk" grows oapwatch_frames_captured_total
before=$(within 60 ids)
rm /var/tmp/fill /var/tmp/rest
check "with room again the journal recovers" within 60 is oapwatch_journal_writable 1
check "nothing waits in memory then" within 60 is oapwatch_journal_unwritten_events 0
check "a full disk loses no alert" within 60 kept "$before"
check "and no delivery" within 90 owes_nothing
check "none was given up" gave_nothing_up

before=$(within 60 ids)
old=$(date +%s%N)
systemctl stop oapwatch
took=$((($(date +%s%N) - old) / 1000000))
check "it stops within two seconds: $took ms" [ $took -lt 2000 ]
check "and cleanly" result success

# A disk of 4 MB, which twelve seconds of frames would fill; the ring believes it may have 64 MB.
small=/run/small
mkdir $small
mount -t tmpfs -o size=4m tmpfs $small
printf '[estimator]\nname = "subpixel-peak"\n[record]\nfolder = "ring"\nlimit_mb = 64.0\nsegment_s = 2.0\n[journal]\npath = "journal.db"\n' >$small/oapwatch.toml
oapwatch run --config $small/oapwatch.toml 2>$small.log &
recorder=$!
made_way() { grep -q "oldest recordings were removed" $small.log && grep -q "recording again" $small.log; }
check "on a full disk the oldest recordings make way" within 120 made_way
check "the journal has the room" within 60 is oapwatch_journal_writable 1
kill $recorder
wait $recorder
check "what is left of the ring can be reviewed" bash -c "printf '[source]\nkind = \"replay\"\nframes = \"ring\"\nspeed = 0.0\n[estimator]\nname = \"subpixel-peak\"\n' >$small/review.toml && oapwatch review --config $small/review.toml"
umount $small

systemctl start oapwatch
check "a stop loses no alert" within 60 kept "$before"

# A camera: vivid's test image with its running clock; 10 × 10 camera pixels to a pixel of the array.
sed -i 's/^kind = "simulator".*/kind = "v4l2"\ndevice = "\/dev\/video0"/; s/^pixels = .*/pixels = [32, 32]\njoules_per_count = 1e-9/; s/^rate_hz = .*/rate_hz = 60.0/' $config
sed -i 's/^\[claims\]/[source.v4l2]\npixel_format = "Y16"\nroi = [0, 0, 320, 320]\n\n[claims]/' $config
check "the config with a camera is good" env CREDENTIALS_DIRECTORY=/run/credentials/oapwatch.service oapwatch check $config
systemctl restart oapwatch
check "it starts without its camera and says so" within 60 is oapwatch_source_connected 0
old=$(pid)
modprobe vivid n_devs=1 node_types=0x1 num_inputs=1 input_types=3
check "a camera plugged in is opened" within 60 is oapwatch_source_connected 1
check "its frames come" grows oapwatch_frames_captured_total
check "frames are usable" within 60 ready
echo vivid.0 >$vivid/unbind
check "the camera unplugged is noticed" within 60 is oapwatch_source_connected 0
check "a lost camera is an alert" within 60 bash -c "curl -fsS '$api/v1/alerts?state=open' | grep sensor_lost"
echo vivid.0 >$vivid/bind
check "plugged in again it is opened again" within 60 is oapwatch_source_connected 1
check "its frames come again" grows oapwatch_frames_captured_total
check "all by the same process" [ "$(pid)" = "$old" ]

# Back to the simulator: an emulated camera leaves an emulated processor little for anything else.
cp /tmp/good $config
systemctl restart oapwatch
rmmod vivid
check "it goes back to the simulator" within 60 ready
cd /
before=$(within 60 ids)
for commands in /guide/*.sh; do
    check "as the guide says: $(head -n 1 "$commands")" bash -e "$commands"
    within 60 ready >/dev/null 2>&1
done
check "the guide's backup, restored, has every alert" within 60 kept "$before"

before=$(within 60 ids)
old=$(pid)
check "the hub of a fleet does not start by itself" bash -c '! systemctl is-active oapwatch-fleet && ! systemctl is-enabled oapwatch-fleet'
check "it starts with the config that is shipped" systemctl start oapwatch-fleet
check "and answers, without a server" within 60 curl -fsS -m 5 http://127.0.0.1:8788/healthz
check "its journal is its own" test -s /var/lib/private/oapwatch-fleet/hub.db
systemctl stop oapwatch-fleet
echo "127.0.0.1 hub.example" >>/etc/hosts
for commands in /fleet/*.sh; do
    check "as the fleet's guide says: $(head -n 1 "$commands")" bash -e "$commands"
done
station_runs() { curl -fsS -m 5 http://127.0.0.1:8788/v1/stations | grep -q '"station":"ap7".*"state":"good"'; }
told() { curl -fsS -m 5 "http://127.0.0.1:8788/v1/alerts?limit=100" | grep -q '"station":"ap7"'; }
check "the access point is known at the hub" within 60 station_runs
check "and its alerts are" within 60 told
old=$(pid)
check "apt upgrades the package" apt-get install -qq -y --no-install-recommends -o Dpkg::Options::=--force-confold /upgrade.deb
check "the new version runs" within 60 restarted "$old"
check "upgrade keeps the config" grep -q 9100 $config
check "upgrade keeps the secret" test -s /etc/oapwatch/credentials/webhook
check "upgrade keeps the journal" within 60 kept "$before"

check "removal stops the service" bash -c 'apt-get remove -qq -y oapwatch && ! systemctl is-active oapwatch && ! systemctl is-active oapwatch-fleet && test -s /etc/oapwatch/oapwatch.toml && test -s /var/lib/private/oapwatch/oapwatch.db'
check "purge ends well" dpkg --purge oapwatch
check "purge removes everything" bash -c '! ls -d /etc/oapwatch /var/lib/private/oapwatch /var/lib/oapwatch /var/lib/private/oapwatch-fleet /var/lib/oapwatch-fleet /usr/share/oapwatch /usr/lib/systemd/system/oapwatch.service /usr/lib/systemd/system/oapwatch-fleet.service /etc/systemd/system/multi-user.target.wants/oapwatch{,-fleet}.service /etc/systemd/system/oapwatch.service.d 2>/dev/null | grep .'
echo "# all $n checks were made"
finish

#!/bin/bash
# Runs inside the VM as root: the package as an operator uses it.
export PATH=/usr/sbin:/usr/bin:/sbin:/bin LC_ALL=C
api=http://127.0.0.1:8787
n=0
check() { # check "what" command...
    n=$((n + 1))
    local what=$1
    shift
    if "$@" >/tmp/out 2>&1; then echo "ok $n - $what"; else
        echo "not ok $n - $what"
        sed 's/^/    # /' /tmp/out | head -n 20
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
ready() { curl -fsS -m 2 $api/readyz; }
pid() { systemctl show -P MainPID oapwatch; }
restarted() { [ "$(pid)" != 0 ] && [ "$(pid)" != "$1" ] && ready; }
alerts() { curl -fsS -m 2 "$api/v1/alerts?limit=100"; }
ids() { alerts | grep -o '"id":"[^"]*"' | sort; }
has_alert() { alerts | grep -q unclaimed_emitter; }

python3 /receiver.py &
check "the package installs" dpkg -i /oapwatch.deb
check "the service is ready as shipped" within 30 ready
check "status says what it does" bash -c 'systemctl status oapwatch --no-pager | grep -i "Status:"'
check "the eavesdropper is alerted" within 30 has_alert

mkdir -p /etc/systemd/system/oapwatch.service.d
printf 'whsec_%s\n' "$(head -c 32 /dev/urandom | base64)" > /etc/oapwatch/credentials/webhook
cat >> /etc/oapwatch/oapwatch.toml <<'C'

[[webhook]]
url = "http://127.0.0.1:9100/hook"
secret_file = "$CREDENTIALS_DIRECTORY/oapwatch_webhook"
C
check "a config with a webhook starts" systemctl restart oapwatch
check "an alert is delivered to the webhook receiver" within 60 grep -q alert.raised /received

before=$(ids); old=$(pid)
kill -9 "$old"
check "kill -9 is survived" within 20 restarted "$old"
check "no alert is lost by kill -9" bash -c 'comm -23 <(echo "$0") <(curl -fsS "'$api'/v1/alerts?limit=100" | grep -o "\"id\":\"[^\"]*\"" | sort) | grep -c . | grep -qx 0' "$before"

printf '[Service]\nWatchdogSec=4\n' > /etc/systemd/system/oapwatch.service.d/watchdog.conf
systemctl daemon-reload; systemctl restart oapwatch; old=$(pid)
kill -STOP "$old"
check "the watchdog restarts a frozen process" within 30 restarted "$old"

old=$(pid)
check "reload keeps the process" bash -c "systemctl reload oapwatch; sleep 1; [ \$(systemctl show -P MainPID oapwatch) = $old ]"
cp /etc/oapwatch/oapwatch.toml /tmp/good; echo 'nonsense = 1' >> /etc/oapwatch/oapwatch.toml
check "a bad file changes nothing on reload" bash -c "systemctl reload oapwatch; sleep 1; [ \$(systemctl show -P MainPID oapwatch) = $old ] && curl -fsS $api/readyz"
cp /tmp/good /etc/oapwatch/oapwatch.toml

date -s '+1 hour' >/dev/null
check "a clock step forward is survived" bash -c "sleep 2; curl -fsS $api/readyz && [ \$(systemctl show -P MainPID oapwatch) = $old ]"
date -s '-2 hours' >/dev/null
check "a clock step backward is survived" bash -c "sleep 2; curl -fsS $api/readyz && [ \$(systemctl show -P MainPID oapwatch) = $old ]"

stop() { local t=$(date +%s%N); systemctl stop oapwatch; [ $((($(date +%s%N) - t) / 1000000)) -lt 2000 ]; }
check "it stops within two seconds" stop
check "and cleanly" bash -c 'systemctl show -P Result oapwatch | grep -qx success'

check "upgrade keeps the config" bash -c 'dpkg -i --force-confold /oapwatch.deb && grep -q 9100 /etc/oapwatch/oapwatch.toml && ls /var/lib/private/oapwatch/oapwatch.db'
check "purge removes everything" bash -c 'dpkg --purge oapwatch && ! ls -d /etc/oapwatch /var/lib/private/oapwatch 2>/dev/null'
[ $n -gt 0 ] && journalctl -u oapwatch --no-pager 2>/dev/null | tail -n 15 | sed 's/^/# /'
python3 -c 'import os; f = os.open("/dev/port", os.O_WRONLY); os.lseek(f, 0xF4, 0); os.write(f, bytes([16]))'

#!/bin/busybox sh
# First process of the test machine: the daemon with its journal on the disk, and a receiver of webhooks. The second
# serial line tells the host what the journal held when the daemon was up, then what the receiver hears.
/bin/busybox --install -s /bin
mount -t devtmpfs dev /dev
mount -t proc proc /proc
mount -t tmpfs tmp /tmp
ip link set lo up
for module in /modules/*; do insmod "$module"; done
stty -F /dev/ttyS1 raw
mount -t ext4 /dev/vda /disk || echo "failed: the file system cannot be mounted" > /dev/ttyS1
httpd -p 127.0.0.1:9100 -h /www
# On a terminal the log is not JSON.
{ oapwatch run --config /oapwatch.toml 2>&1; echo "failed: the daemon ended"; } | cat > /dev/ttyS1 &

# ask PATH FILE: until the daemon answers.
ask() {
    until wget -q -O "$2" "http://127.0.0.1:8787$1" 2> /dev/null; do sleep 0.1; done
}
page='/v1/alerts?limit=1000'
while [ -n "$page" ]; do
    ask "$page" /tmp/page
    grep -o '"id":"[^"]*"\|"state":"[^"]*"' /tmp/page | cut -d '"' -f 4 | paste -d ' ' - - | sed 's/^/kept /' > /dev/ttyS1
    cursor=$(grep -o '"next_cursor":"[^"]*"' /tmp/page | cut -d '"' -f 4)
    page=${cursor:+"/v1/alerts?limit=1000&cursor=$cursor"}
done
echo "listed" > /dev/ttyS1
while :; do sleep 3600; done

#!/bin/sh
# Receiver of webhooks: tells the host, then confirms.
{ head -c "$CONTENT_LENGTH"; echo; } | sed -n 's/^{"type":"\([^"]*\)".*"data":{"id":"\([^"]*\)".*/heard \2 \1/p' > /dev/ttyS1
printf 'Status: 204 No Content\r\n\r\n'

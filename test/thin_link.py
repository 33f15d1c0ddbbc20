"""Two hosts on one machine, joined by a thin link: network namespaces with a TAP device each.

This process carries the Ethernet frames from one to the other: it loses some, holds each for a
while and lets only so many bits through a second. It needs no traffic control in the kernel.
"""

import fcntl
import heapq
import os
import select
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

TUN, TUNSETIFF, IFF_TAP, IFF_NO_PI = '/dev/net/tun', 0x400454CA, 0x0002, 0x1000
LOSS, DELAY_S, BITS_PER_S = 0.01, 0.005, 20e6
MAX_QUEUE_S = 0.2
FRAME_BYTES = 2000


def why_not() -> str:
    """Return why such a link cannot be made here; empty where it can."""
    if os.geteuid() != 0:
        return 'network namespaces need root'
    if not os.access(TUN, os.R_OK | os.W_OK):
        return f'there is no {TUN}'
    try:
        probe = subprocess.run(['ip', 'netns'], capture_output=True)
    except FileNotFoundError:
        return 'the command ip (iproute2) is not installed'
    return probe.stderr.decode() if probe.returncode else ''


def inside(host: str, memory: Path, command: list[str]) -> list[str]:
    """Return a command as it runs on a host; the hosts share no memory, their processes do."""
    mount = f'mount --bind {memory} /dev/shm && exec "$@"'
    return ['ip', 'netns', 'exec', host, 'sh', '-c', mount, 'sh', *command]


def open_tap(name: str, host: str, address: str) -> int:
    """Make a TAP device in a new namespace and return its file."""
    tap = os.open(TUN, os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tap, TUNSETIFF, struct.pack('16sH', name.encode(), IFF_TAP | IFF_NO_PI))
    subprocess.run(['ip', 'netns', 'add', host], check=True)
    subprocess.run(['ip', 'link', 'set', name, 'netns', host], check=True)
    for words in (
        ['address', 'add', f'{address}/24', 'dev', name],
        ['link', 'set', name, 'up'],
        ['link', 'set', 'lo', 'up'],
        ['route', 'add', 'default', 'dev', name],
    ):
        subprocess.run(['ip', '-n', host, *words], check=True)
    return tap


def carry(taps: list[int], deadline_s: float) -> None:
    """Carry frames between both ends until the deadline."""
    rng = np.random.default_rng(1)
    other = {taps[0]: taps[1], taps[1]: taps[0]}
    free_s = dict.fromkeys(taps, 0.0)
    on_the_way: list[tuple[float, int, int, bytes]] = []
    count = 0
    while (now_s := time.monotonic()) < deadline_s:
        while on_the_way and on_the_way[0][0] <= now_s:
            _, _, tap, frame = heapq.heappop(on_the_way)
            os.write(tap, frame)
        wait_s = on_the_way[0][0] - now_s if on_the_way else 0.1
        ready, _, _ = select.select(taps, [], [], max(wait_s, 0.0))
        for tap in ready:
            frame, count = os.read(tap, FRAME_BYTES), count + 1
            begin_s = max(free_s[tap], time.monotonic())
            if rng.random() < LOSS or begin_s - time.monotonic() > MAX_QUEUE_S:
                continue
            free_s[tap] = begin_s + 8 * len(frame) / BITS_PER_S
            heapq.heappush(on_the_way, (free_s[tap] + DELAY_S, count, other[tap], frame))


def main() -> None:
    """Join two hosts, named on the command line, for so many seconds."""
    hosts, seconds = sys.argv[1:3], float(sys.argv[3])
    taps = [open_tap(f'{h[-8:]}t', h, f'10.77.0.{i + 1}') for i, h in enumerate(hosts)]
    print('joined', flush=True)
    carry(taps, time.monotonic() + seconds)


if __name__ == '__main__':
    main()

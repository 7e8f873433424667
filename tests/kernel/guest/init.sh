#!/bin/bash
# The first program of the virtual machine. It starts the services of a computer with Linux, then the agent.
# The kernel's command line has the paths of the kernel's modules, Python and the project, and the agent's TCP port.
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LC_ALL=C.UTF-8
for word in $(cat /proc/cmdline); do
    case $word in rig.*) declare "${word#rig.}" ;; esac
done
release=$(uname -r)
mount -t tmpfs run /run
mkdir -p /run/udev /run/lock /dev/pts /dev/shm
mount -t devpts devpts /dev/pts
mount -t tmpfs shm /dev/shm
mkdir -p /lib/modules
[ -e "/lib/modules/$release" ] || ln -sfn "$modules" "/lib/modules/$release"
start_devices_and_network() {
    echo "udev $(cut -d" " -f1 /proc/uptime)"; busybox hostname kernel-test
    busybox ifconfig lo 127.0.0.1 up
    if [ -x /lib/systemd/systemd-udevd ]; then /lib/systemd/systemd-udevd --daemon; else udevd --daemon; fi
    modprobe -a virtio_net vhci-hcd i2c-dev  # the tests need no other devices from the start, so no `udevadm trigger`
    udevadm settle --timeout=60; echo "settled $(cut -d" " -f1 /proc/uptime)"
    for _ in {1..100}; do
        network=$(ls /sys/class/net | grep -v '^lo$' | head -1)
        [ -n "$network" ] && break
        sleep 0.1
    done
    busybox ifconfig "$network" 10.0.2.15 netmask 255.255.255.0 up
    busybox route add default gw 10.0.2.2
}
start_devices_and_network &  # while the agent imports what the programs need
cd "$project" || exit 1
echo "agent $(cut -d" " -f1 /proc/uptime)"; exec "$python" -m tests.kernel.guest.agent "$port"

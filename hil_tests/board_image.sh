# sh -e board_image.sh CACHE: Debian on an aarch64 disk, its kernel, and the key that opens it.
# `hil_tests board` runs it in a mount namespace of its own.
# The kernel's handler of aarch64 programs has a name of its own, and goes when this ends.
cache=$1 root=$1/root
rm -rf "$cache/key" "$cache/key.pub" "$root"
ssh-keygen -q -t ed25519 -N '' -f "$cache/key"
kernel=/proc/sys/fs/binfmt_misc
[ -e $kernel/register ] || mount -t binfmt_misc binfmt_misc $kernel
if [ ! -e $kernel/qemu-aarch64 ]; then
    line=$(sed s/qemu-aarch64:/phil-aarch64:/ /usr/lib/binfmt.d/qemu-aarch64.conf)
    printf %s "${line%F}F" > $kernel/register
    trap 'echo -1 > $kernel/phil-aarch64' EXIT
fi
debootstrap --arch=arm64 --variant=minbase --include=python3,systemd-sysv,dbus,udev,iproute2,openssh-server,openssh-client,linux-image-cloud-arm64 bullseye "$root" >&2
cd "$root"
mkdir -p root/.ssh
cp "$cache/key.pub" root/.ssh/authorized_keys
chmod 0700 root/.ssh
printf '[Match]\nName=e*\n[Network]\nAddress=10.0.2.15/24\n' > etc/systemd/network/10.network
ln -s /lib/systemd/system/systemd-networkd.service etc/systemd/system/multi-user.target.wants/
echo board > etc/hostname
echo '127.0.0.1 localhost board' > etc/hosts
echo '/dev/vda / ext4 defaults 0 1' > etc/fstab
rm -rf debootstrap var/cache/apt/archives/*.deb usr/share/doc usr/share/locale
cp boot/vmlinuz-* "$cache/kernel"
cp boot/initrd.img-* "$cache/initrd"
truncate -s 3G "$cache/draft"
mkfs.ext4 -q -F -d . "$cache/draft"
mv "$cache/draft" "$cache/disk"

import stat
import subprocess
import sys

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key, load_pem_public_key

from deploy.__main__ import main
from edge_runtime.cli import run_cli


def test_a_pair_fits_together_and_the_private_half_is_private(tmp_path):
    assert run_cli(main, ["keys", "--out", str(tmp_path / "keys")]) == 0
    private_path, public_path = tmp_path / "keys/policy.key", tmp_path / "keys/policy.pub"
    private = load_pem_private_key(private_path.read_bytes(), password=None)
    public = load_pem_public_key(public_path.read_bytes())
    assert isinstance(private, Ed25519PrivateKey)
    assert isinstance(public, Ed25519PublicKey)
    public.verify(private.sign(b"policy"), b"policy")
    assert stat.S_IMODE(private_path.stat().st_mode) == 0o600


def test_a_key_is_never_overwritten(tmp_path, capsys):
    assert run_cli(main, ["keys", "--out", str(tmp_path)]) == 0
    before = (tmp_path / "policy.key").read_bytes()
    capsys.readouterr()
    assert run_cli(main, ["keys", "--out", str(tmp_path)]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert (tmp_path / "policy.key").read_bytes() == before


def test_a_place_that_is_no_directory_is_refused(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert run_cli(main, ["keys", "--out", str(tmp_path / "file" / "keys")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_two_files_take_few_modules(tmp_path):
    """Nothing of bundles, certificates or the wire is loaded to write a pair."""
    program = (
        "import sys; from deploy.__main__ import main; main(sys.argv[1:]);"
        " print(*(name for name in sys.modules if name.startswith(('deploy', 'edge_runtime'))))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, "keys", "--out", str(tmp_path / "keys")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    ours = done.stdout.splitlines()[-1].split()
    assert len(ours) <= 10, ours

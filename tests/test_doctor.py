"""Help, examples, completion and doctor: what a person meets before any data."""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from torchrecon.cli import doctor, main
from torchrecon.cli.completion import script
from torchrecon.cli.examples import EXAMPLES
from torchrecon.cli.parser import build_parser

ROOT = Path(__file__).resolve().parents[1]


def complete_in_bash(*words: str) -> set[str]:
    """What bash offers for the last word."""
    typed = f"COMP_WORDS=({shlex.join(words)}); COMP_CWORD={len(words) - 1}"
    ask = f"{typed}; _torchrecon; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    done = subprocess.run(["bash", "-c", f"{script('bash')}\n{ask}"], capture_output=True, text=True, check=True)
    assert not done.stderr
    return set(done.stdout.split())


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_completes_commands_options_and_choices():
    assert complete_in_bash("torchrecon", "rec") == {"reconstruct"}
    assert {"solve", "rank", "doctor", "--help"} <= complete_in_bash("torchrecon", "")
    assert complete_in_bash("torchrecon", "rank", "t.npz", "--l") == {"--layout"}
    assert complete_in_bash("torchrecon", "rank", "--layout", "") == {"vector", "stack"}
    assert complete_in_bash("torchrecon", "completion", "") == {"bash", "zsh", "fish"}
    assert complete_in_bash("torchrecon", "solve", "") == set()  # left to file names
    assert complete_in_bash("torchrecon", "solve", "--layout", "--ra") == {"--rank"}  # another command's option


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
def test_zsh_reads_the_script():
    subprocess.run(["zsh", "-n"], input=script("zsh"), text=True, check=True)


@pytest.mark.skipif(shutil.which("fish") is None, reason="fish is not installed")
def test_fish_completes_commands_options_and_choices():
    def ask(line: str) -> set[str]:
        code = f"{script('fish')}\ncomplete -C {shlex.quote(line)}"
        done = subprocess.run(["fish", "--no-config", "-c", code], capture_output=True, text=True, check=True)
        return {offer.split("\t")[0] for offer in done.stdout.splitlines()}

    assert ask("torchrecon reco") == {"reconstruct"}
    assert ask("torchrecon rank --lay") == {"--layout"}
    assert ask("torchrecon rank --layout ") == {"vector", "stack"}


def parsers() -> dict[str, argparse.ArgumentParser]:
    (found,) = (a.choices for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    return dict(found)


def test_every_command_has_examples_and_every_example_parses(capsys):
    assert set(EXAMPLES) == {"", *parsers()}
    for command, lines in EXAMPLES.items():
        with pytest.raises(SystemExit):
            main([command, "--help"] if command else ["--help"])
        shown = capsys.readouterr().out
        for line, text in lines:
            assert line in shown
            assert text in shown
            words = shlex.split(line.replace("source <(", "").replace(") ", " ").rstrip(")").removesuffix(" | source"))
            assert words[0] == "torchrecon"
            options = build_parser().parse_args(words[1:])
            assert command in ("", options.command)


def test_every_argument_says_what_it_is():
    for name, parser in parsers().items():
        for action in parser._actions:
            assert action.help, (name, action.dest)


def test_doctor_knows_every_dependency_and_extra(capsys):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    names = {requirement.split(">")[0].split("[")[0] for requirement in project["dependencies"]}
    assert set(doctor.CORE) == names
    extras = {
        extra: tuple(requirement.split(">")[0].split("[")[0] for requirement in requirements)
        for extra, requirements in project["optional-dependencies"].items()
        if extra not in ("dev", "docs")  # for a checkout only
    }
    assert {extra: distributions for extra, (distributions, _) in doctor.EXTRAS.items()} == extras
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["core"]["torch"] == {"version": __import__("torch").__version__, "problem": None}
    assert main(["doctor"]) == 0
    assert "devices: cpu" in capsys.readouterr().out


def test_doctor_works_where_torch_does_not(tmp_path):
    (tmp_path / "torch.py").write_text("raise OSError('libtorch_cpu.so: cannot open shared object file')")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
    code += "from torchrecon.cli import main\nsys.exit(main(['doctor']))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 2
    assert "libtorch_cpu.so" in done.stderr
    assert "Traceback" not in done.stderr
    assert "ok  numpy" in done.stdout


def test_a_missing_extra_is_named_with_its_gift(monkeypatch):
    monkeypatch.setitem(doctor.EXTRAS, "io", (("no-such-distribution",), "reads and writes C3D marker files"))
    extra = doctor.examine()["extras"]["io"]
    assert extra["missing"] == ["no-such-distribution"]
    assert extra["install"] == "pip install 'torchrecon[io]'"
    assert any("C3D" in line and "pip install" in line for line in doctor._lines(doctor.examine()))


def test_a_reader_that_has_seen_enough_is_no_error():
    command = [sys.executable, "-m", "torchrecon", "completion", "bash"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()  # before a word is written
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait() == 0


def test_help_and_completion_load_nothing_heavy():
    code = "import sys\nfrom torchrecon.cli import main\nmain(['completion', 'fish'])\n"
    code += "try:\n    main(['export', '--help'])\nexcept SystemExit:\n    pass\n"
    code += "assert not {'torch', 'numpy', 'cv2', 'lightning'} & {name.split('.')[0] for name in sys.modules}"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True)

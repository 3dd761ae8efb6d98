"""Completion scripts for shells, made from the parser itself so that they never lag behind it."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator

from torchrecon.cli.parser import build_parser

__all__ = ["SHELLS", "run", "script"]


def run(options: argparse.Namespace) -> None:
    """``torchrecon completion``."""
    print(script(options.shell), end="")


def script(shell: str) -> str:
    """The completion script of a shell in :data:`SHELLS`.

    Example:
        >>> script("bash").splitlines()[-1]
        'complete -o default -F _torchrecon torchrecon'
    """
    return "\n".join(SHELLS[shell](build_parser())) + "\n"


def _commands(parser: argparse.ArgumentParser) -> dict[str, tuple[str, argparse.ArgumentParser]]:
    """Help and parser of each command."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            texts = {choice.dest: choice.help or "" for choice in action._choices_actions}
            return {name: (texts[name], command) for name, command in action.choices.items()}
    return {}


def _options(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    return (action for action in parser._actions if action.option_strings)


def _choices(action: argparse.Action) -> list[str]:
    return [str(choice) for choice in action.choices or ()]


def _positional_choices(parser: argparse.ArgumentParser) -> list[str]:
    return [c for action in parser._actions if not action.option_strings for c in _choices(action)]


def _offer(words: list[str]) -> str:
    return f'COMPREPLY=($(compgen -W "{" ".join(words)}" -- "$current"))'


def _bash(parser: argparse.ArgumentParser) -> Iterator[str]:
    commands = _commands(parser)
    top = [*commands, *(name for action in _options(parser) for name in action.option_strings)]
    yield "_torchrecon() {"
    yield '    local current="${COMP_WORDS[COMP_CWORD]}" previous="${COMP_WORDS[COMP_CWORD-1]}"'
    yield '    local command="${COMP_WORDS[1]}" options="" values=""'
    yield (
        '    if [[ $COMP_CWORD -eq 1 ]]; then COMPREPLY=($(compgen -W "'
        + " ".join(top)
        + '" -- "$current")); return; fi'
    )
    yield '    case "$command $previous" in'
    for name, (_, command) in commands.items():
        for action in _options(command):
            if action.choices:
                pattern = "|".join(f'"{name} {option}"' for option in action.option_strings)
                yield f"        {pattern}) {_offer(_choices(action))}; return;;"
    yield "    esac"
    yield '    case "$command" in'
    for name, (_, command) in commands.items():
        options = " ".join(option for action in _options(command) for option in action.option_strings)
        yield f'        {name}) options="{options}" values="{" ".join(_positional_choices(command))}";;'
    yield "    esac"
    yield '    [[ $current == -* ]] || options="$values"'
    yield f"    {_offer(['$options'])}"  # empty: bash goes on with file names
    yield "}"
    yield "complete -o default -F _torchrecon torchrecon"


def _zsh(parser: argparse.ArgumentParser) -> Iterator[str]:
    def quoted(text: str) -> str:
        return "'" + text.replace("'", "'\\''") + "'"

    def escaped(text: str) -> str:
        for sign in "\\[]:":
            text = text.replace(sign, "\\" + sign)
        return text

    yield "#compdef torchrecon"
    yield "_torchrecon() {"
    yield "    local -a commands"
    yield "    commands=("
    for name, (text, _) in _commands(parser).items():
        yield f"        {quoted(f'{name}:{text}')}"
    yield "    )"
    yield "    if (( CURRENT == 2 )); then _describe command commands; return; fi"
    yield "    local command=$words[2]"
    yield "    shift words; (( CURRENT-- ))"
    yield "    case $command in"
    for name, (_, command) in _commands(parser).items():
        specs = []
        for action in _options(command):
            value = f"({' '.join(_choices(action))})" if action.choices else "_files"
            takes = "" if action.nargs == 0 else f":{escaped(str(action.metavar or action.dest))}:{value}"
            specs += [quoted(f"{option}[{escaped(action.help or '')}]{takes}") for option in action.option_strings]
        fixed = _positional_choices(command)
        specs.append(quoted(f"*:value:({' '.join(fixed)})" if fixed else "*:file:_files"))
        yield f"        {name}) _arguments {' '.join(specs)};;"
    yield "    esac"
    yield "}"
    yield "compdef _torchrecon torchrecon"


def _fish(parser: argparse.ArgumentParser) -> Iterator[str]:
    def quoted(text: str) -> str:
        return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"

    for name, (text, command) in _commands(parser).items():
        yield f"complete -c torchrecon -n __fish_use_subcommand -f -a {name} -d {quoted(text)}"
        inside = f"complete -c torchrecon -n '__fish_seen_subcommand_from {name}'"
        for action in _options(command):
            flags = " ".join(f"-l {o[2:]}" if o.startswith("--") else f"-s {o[1:]}" for o in action.option_strings)
            takes = "" if action.nargs == 0 else " -r"
            if action.choices:
                takes = f" -x -a {quoted(' '.join(_choices(action)))}"
            yield f"{inside} {flags}{takes} -d {quoted(action.help or '')}"
        if fixed := _positional_choices(command):
            yield f"{inside} -f -a {quoted(' '.join(fixed))}"


SHELLS: dict[str, Callable[[argparse.ArgumentParser], Iterator[str]]] = {"bash": _bash, "zsh": _zsh, "fish": _fish}

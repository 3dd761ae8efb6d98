"""The command line ``torchrecon``; nothing heavy is loaded before a command runs."""

from __future__ import annotations

import importlib
import os
import sys

from torchrecon.cli.parser import build_parser
from torchrecon.errors import ReconError

__all__ = ["main"]


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Returns:
        0 when done, 2 for unusable input (one sentence on stderr), 130 when interrupted.
    """
    options = build_parser().parse_args(arguments)
    # The first two have to work where torch does not.
    module = options.command if options.command in ("doctor", "completion") else "commands"
    try:
        importlib.import_module(f"torchrecon.cli.{module}").run(options)
        sys.stdout.flush()
    except ReconError as error:
        print(f"torchrecon {options.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"torchrecon {options.command}: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # whoever reads the output, like head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0

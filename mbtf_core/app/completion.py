"""Completion of commands, options and files in the user's shell: ``--install-completion``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, Parameter

from mbtf_core.errors import UsageError

Shell = Literal["bash", "zsh", "fish", "powershell"]


# Enables completion in zsh where no configuration has done so.
_ZSH_COMPLETION = "(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }"


class CompletedApp(App):
    """An application whose completion in bash leaves file names to the shell, and whose completion in fish
    offers options after the argument of the default command.

    Bash adds a slash to a folder and quotes spaces; the word list of cyclopts does neither.
    """

    def generate_completion(self, **options: Any) -> str:
        """Script of the completion for a shell; the parameters are those of cyclopts."""
        script: str = super().generate_completion(**options)
        script = script.replace('COMPREPLY=( $(compgen -f -- "${cur}") )', "COMPREPLY=()")
        for kind in ("-l", "-s"):
            no_command = f"-n __fish_{self.name[0]}_using_command"
            script = script.replace(f"-n __fish_use_subcommand {kind} ", f"{no_command} {kind} ")
        return script.replace("\ncomplete -F ", "\ncomplete -o default -F ")


def _enable_in_zsh(startup: Path) -> None:
    """Have zsh complete at all: a new user's configuration does not load its completion system."""
    text = startup.read_text(encoding="utf-8", errors="surrogateescape") if startup.exists() else ""
    if _ZSH_COMPLETION not in text:
        end = "" if text.endswith("\n") or not text else "\n"
        with startup.open("a", encoding="utf-8") as stream:
            stream.write(f"{end}{_ZSH_COMPLETION}\n")


def add_completion(app: App) -> None:
    """Add the option ``--install-completion`` to a program."""

    def install(
        *,
        shell: Annotated[Shell | None, Parameter(help="By default the shell in use.")] = None,
    ) -> None:
        """Install completion for the shell in use."""
        from cyclopts.completion.detect import ShellDetectionError

        try:
            path = app.install_completion(shell=shell)
        except ShellDetectionError:
            raise UsageError(
                "the shell in use is unknown", hint=f"{app.name[0]} --install-completion --shell bash"
            ) from None
        if path.name.startswith("_"):
            _enable_in_zsh(Path.home() / ".zshrc")
        print(f"{path}: completion of {app.name[0]}; a new shell loads it")

    app.command(install, name="--install-completion")

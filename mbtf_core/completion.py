"""Completion of commands, options and files in the user's shell: ``--install-completion``."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from cyclopts import App, Parameter

from mbtf_core.errors import UsageError

Shell = Literal["bash", "zsh", "fish", "powershell"]


class CompletedApp(App):
    """An application whose completion in bash leaves file names to the shell.

    Bash adds a slash to a folder and quotes spaces; the word list of cyclopts does neither.
    """

    def generate_completion(self, **options: Any) -> str:
        """Script of the completion for a shell; the parameters are those of cyclopts."""
        script: str = super().generate_completion(**options)
        script = script.replace('COMPREPLY=( $(compgen -f -- "${cur}") )', "COMPREPLY=()")
        return script.replace("\ncomplete -F ", "\ncomplete -o default -F ")


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
        print(f"{path}: completion of {app.name[0]}; a new shell loads it")

    app.command(install, name="--install-completion")

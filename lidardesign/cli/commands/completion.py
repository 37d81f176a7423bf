"""`lidardesign completion`: the script that makes a shell ask the program what may stand at its cursor."""

from __future__ import annotations

import contextlib
import os
import signal
from typing import Annotated

import typer

from lidardesign.cli import options
from lidardesign.cli.output import command
from lidardesign.errors import check_choice

# Set where the program is asked; its value is the shell.
VARIABLE = "_LIDARDESIGN_COMPLETE"

BASH = r"""# Completion of lidardesign for bash 4.4 or newer:
#   lidardesign completion bash > ~/.local/share/bash-completion/completions/lidardesign
_lidardesign() {
    local IFS=$'\n' current=${COMP_WORDS[COMP_CWORD]} lines=() kind
    mapfile -t lines < <(_LIDARDESIGN_COMPLETE=bash COMP_LINE="$COMP_LINE" COMP_POINT="$COMP_POINT" \
        "${COMP_WORDS[0]/#\~\//$HOME/}" 2>/dev/null)
    kind=${lines[0]}
    # what follows = or : is a word of its own to bash
    [[ $current == [=:] ]] && current=
    case $kind in
        files) compopt -o filenames; mapfile -t COMPREPLY < <(compgen -f -- "$current") ;;
        folders) compopt -o filenames; mapfile -t COMPREPLY < <(compgen -d -- "$current") ;;
        paths) compopt -o filenames; COMPREPLY=("${lines[@]:1}") ;;
        open) compopt -o nospace; COMPREPLY=("${lines[@]:1}") ;;
        *) COMPREPLY=("${lines[@]:1}") ;;
    esac
}
complete -F _lidardesign lidardesign
"""

ZSH = r"""#compdef lidardesign
# Completion of lidardesign for zsh, in a folder of $fpath:
#   lidardesign completion zsh > "${fpath[1]}/_lidardesign"
_lidardesign() {
    local -a lines values shown open_values open_shown
    local kind line value
    lines=("${(@f)$(_LIDARDESIGN_COMPLETE=zsh "${(Q)words[1]}" "${(@Q)words[2,CURRENT]}" 2>/dev/null)}")
    kind=$lines[1]
    case $kind in
        files) _files; return ;;
        folders) _files -/; return ;;
    esac
    for line in "${(@)lines[2,-1]}"; do
        value=${line%%$'\t'*}
        [[ $line == *$'\t'?* ]] && line="$value  -- ${line#*$'\t'}" || line=$value
        if [[ $value == *[=:,/] ]]; then
            open_values+=("$value"); open_shown+=("$line")
        else
            values+=("$value"); shown+=("$line")
        fi
    done
    (( $#values )) && compadd -l -d shown -a values
    (( $#open_values )) && compadd -l -S '' -d open_shown -a open_values
    return 0
}
if [[ $funcstack[1] == _lidardesign ]]; then
    _lidardesign "$@"
else
    compdef _lidardesign lidardesign
fi
"""

FISH = r"""# Completion of lidardesign for fish 3.1 or newer:
#   lidardesign completion fish > ~/.config/fish/completions/lidardesign.fish
function __lidardesign_complete
    set -l before (commandline -opc)
    set -l current (commandline -ct)
    set -l lines (_LIDARDESIGN_COMPLETE=fish $before[1] $before[2..-1] "$current" 2>/dev/null)
    switch "$lines[1]"
        case files
            __fish_complete_path "$current"
        case folders
            __fish_complete_directories "$current"
        case '*'
            test (count $lines) -gt 1; and printf '%s\n' $lines[2..-1]
    end
end
complete -c lidardesign -f -a '(__lidardesign_complete)'
"""

SCRIPTS = {"bash": BASH, "zsh": ZSH, "fish": FISH}
# Nobody waits longer at a prompt: plugins that hang while they are imported are left out.
MOST_SECONDS = 5.0


def completion(
    shell: Annotated[str, typer.Argument(metavar="|".join(SCRIPTS), help="The shell.")],
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Print the script that completes commands, options, tasks, keys, formats, parts, runs and designs in a shell."""
    with command(json=json, quiet=quiet, debug=debug) as output:
        document = {"shell": shell, "script": SCRIPTS[check_choice(shell, "SHELL", tuple(SCRIPTS))]}
        output.result(document, lambda rich: print(document["script"], end="", file=output.stream), show_costs=False)


def answer_shell(app: typer.Typer) -> int:
    """Answer a shell; where that fails nobody can be asked, and nothing is completed."""
    with contextlib.suppress(ValueError, AttributeError):
        # by its default the signal ends the process, whatever a plugin does
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, MOST_SECONDS)
    try:
        with open(os.devnull, "w", encoding="utf-8") as nowhere, contextlib.redirect_stdout(nowhere):
            from lidardesign.cli.candidates import BashCompletion, ShellCompletion

            shell = BashCompletion if os.environ[VARIABLE] == "bash" else ShellCompletion
            answer = shell(typer.main.get_command(app), {}, "lidardesign", VARIABLE).complete()
    except Exception:
        return 1
    print(answer)
    return 0

"""A trigger of the virtual interferometer that starts ten times as fast as the program that ships."""

from __future__ import annotations

#: As dm_simulation.interferometer.trigger: ask the virtual bench on port $0 for a map in the file $1.
_ASK = """
exec 3<>"/dev/tcp/127.0.0.1/$0" && echo "MEASURE $1" >&3 && read -r answer <&3 && echo "$answer" && [[ $answer = OK* ]]
"""


def quick_trigger(port: int | str) -> list[str]:
    """For the parameter `trigger_command`; the program that ships has tests of its own."""
    return ["bash", "-c", _ASK, str(port), "{path}"]

"""How the terminal UI behaves: bounds that keep it small over SSH and on a gateway's own console."""

from msgspec import Struct

from appliance.errors import ConfigError


class TuiConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the terminal UI."""

    refresh_hz: float = 3.0
    """Redraws a second at most; only rows that changed are sent to the terminal."""
    tasks: int = 200
    """Tasks remembered, newest first."""
    entries: int = 2000
    """Lines of the log screen remembered."""
    resync_s: float = 15.0
    """How often the task list is asked for as a whole, in case a push was missed."""
    reconnect_s: float = 2.0
    """Pause between attempts to connect."""
    silence_s: float = 6.0
    """Without any gateway for so long, the connection is made anew."""
    plan_timeout_s: float = 60.0
    """A plan by a language model on a small gateway takes seconds."""
    call_timeout_s: float = 10.0
    """Every other question."""

    def check(self) -> None:
        """Raise ConfigError for values that cannot work, naming the key."""
        if not 0.2 <= self.refresh_hz <= 20:
            raise ConfigError(f"tui.refresh_hz is {self.refresh_hz}", remedy="give 0.2 to 20 redraws a second")
        for key in ("tasks", "entries"):
            if getattr(self, key) < 1:
                raise ConfigError(f"tui.{key} is {getattr(self, key)}", remedy="give a number above 0")
        for key in ("resync_s", "reconnect_s", "silence_s", "plan_timeout_s", "call_timeout_s"):
            if not getattr(self, key) > 0:
                raise ConfigError(f"tui.{key} is {getattr(self, key)}", remedy="give a time above 0 seconds")

"""The page that the browser gets: a terminal that speaks to this server and to nobody else. Pure."""

from html import escape

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; font-src 'self'; img-src 'self' data:; "
    "connect-src 'self' ws://{host}; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
"""Content security policy: the terminal's script sets styles of its own."""

STYLE = """
@font-face { font-family: "Roboto Mono"; src: url("/static/fonts/RobotoMono-VariableFont_wght.ttf"); }
html, body { height: 100%; margin: 0; background: #0c181f; color: #e8eef0; font-family: "Roboto Mono", monospace; }
#terminal { height: 100vh; }
.told { display: none; position: absolute; inset: 0; align-items: center; justify-content: center; }
.told { background: #0c181f; }
.told a { color: inherit; }
body:not(.-first-byte) .opening, body.-closed .closed { display: flex; z-index: 10; }
body.-closed .opening { display: none; }
"""

SCRIPT = """
// The token has done its work: it is in the cookie now, and needs to be neither in the address bar nor in the history.
history.replaceState(null, "", location.pathname);
// Keys, that of the soft stop above all, must reach the terminal without a click first.
const seeking = setInterval(() => {
  const field = document.querySelector(".xterm-helper-textarea");
  if (field) { clearInterval(seeking); field.focus(); }
}, 100);
"""

_PAGE = """<!DOCTYPE html>
<html lang="en">
  <head>
    <meta charset="utf-8">
    <title>{title}</title>
    <link rel="icon" href="data:,">
    <link rel="stylesheet" href="/static/css/xterm.css">
    <link rel="stylesheet" href="/page.css">
    <script src="/page.js"></script>
    <script src="/static/js/textual.js"></script>
  </head>
  <body>
    <div class="told opening">opening {title} …</div>
    <div class="told closed"><p>The session has ended. <a href="/">Open it again</a></p></div>
    <div id="terminal" class="textual-terminal" data-session-websocket-url="ws://{host}/ws"
      data-font-size="{size}"></div>
  </body>
</html>
"""


def page(title: str, host: str, *, size: int = 16) -> str:
    """Return the page of a fleet's terminal UI, for a browser that asked this host for it."""
    return _PAGE.format(title=escape(title), host=escape(host), size=size)

"""Plans on screen: their shape, editing one before it is approved, what an edit changed, and help while writing one.

All of it is pure: no Textual, no network. `shape` orders and indents, `editing` is the editor's model, `difference`
tells what was changed, `completing` and `history` help with the instruction.
"""

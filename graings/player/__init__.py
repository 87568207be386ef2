"""Player: a trained scene as one small file that a browser plays, the player itself (`web/`), and both in one page."""

"""Footage: a video or a folder of photographs without poses, and the capture that is made of it."""

"""Tests of graings.player."""

"""The command line."""

from graings.cli.main import main as main

"""`python -m graings`: the same as the command `graings`."""

from graings.cli.main import main

main()

"""`python -m graings`: the same as the command `graings`."""

from graings.cli import main

main()

"""`python -m graings`: equivalent to the command `graings`."""

from graings.cli.main import main

# The service reads uploads in processes that load this module again, under another name.
if __name__ == "__main__":
    main()

"""What a launch of a kernel is given: arguments by their types, constants, and settings that the autotuner chooses."""

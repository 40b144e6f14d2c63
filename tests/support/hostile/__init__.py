"""Files and requests as an attacker, or bad luck, makes them."""

"""The fast form of C: GNU C, vector registers, whatever was measured to pay."""

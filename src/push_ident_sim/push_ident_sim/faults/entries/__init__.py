"""The faults, by theme: each is a row of the table, with a function that injects it and checks what it must not break."""

"""One focus cycle: the hot loop, the phases around it, and the rules that stop it."""

"""How good an estimate is, with its uncertainty."""

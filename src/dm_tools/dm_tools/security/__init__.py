"""The hardened profile: SROS 2 policies for each node, and the check that a keystore conforms to them."""

"""The hardened profile: what each node may say and hear, as SROS 2 policies, and whether a keystore keeps to it."""

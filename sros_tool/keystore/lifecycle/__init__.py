"""The life of a keystore: create, renew, revoke, rotate its CAs."""

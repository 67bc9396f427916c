"""The collection for Ansible: what its modules do, without Ansible."""

"""Every numerical kernel against a reference of fifty digits: how many digits it loses, over ranges that hurt."""

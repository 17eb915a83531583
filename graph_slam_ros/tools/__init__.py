"""Tools beside the SLAM: worlds, reports, fleets, advice, certificates. The core never imports them."""

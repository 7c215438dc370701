from gapcert_networks.bounds import NetworkBound as NetworkBound
from gapcert_networks.bounds import NetworkCertifier as NetworkCertifier
from gapcert_networks.bounds import Proposal as Proposal
from gapcert_networks.network import Network as Network
from gapcert_networks.network_constant import proved_balanced as proved_balanced
from gapcert_networks.network_local import LocalBound as LocalBound
from gapcert_networks.network_local import local_bound as local_bound
from gapcert_networks.theorem1_network import raised as raised

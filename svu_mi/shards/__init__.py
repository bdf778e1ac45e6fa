"""One capture in shards of its photographs: partial sums, here or on a cluster, that are added.

    driver                                      worker
    job: what is loaded, which views   ------>  work: loads its views, traces, sums; a file per sum
    sharded: adds files, in order      <------
    cluster: hands tasks out (Dask), or does them one by one
"""

from svu_mi.shards.gathering import gather_shards as gather_shards
from svu_mi.shards.sharded import Sharded as Sharded

"""What bridge and trainer show in rerun alike: where it goes, the road from above, the plots."""

import os

# Read when rerun is imported. It has several lines for a viewer that is gone; ours says it all.
os.environ.setdefault("RUST_LOG", "warn,re_grpc_client=off,re_sdk=off")

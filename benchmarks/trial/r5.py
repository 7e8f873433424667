import sys; sys.path.insert(0,"benchmarks/trial")
from rank import *
L1=[("edges","own",1,1),("colours","own",1,1),("cedd","own",1,.6)]
specs={
 "today e.6c.4 raw":[("edges","raw",0,.6),("colours","raw",0,.4)],
 "E,C own1":L1[:2],
 "E,C,D own1":L1,
 "N raw":[("network","raw",0,1)],
 "N own1":[("network","own",1,1)],
 "E,C,D,N4 raw":L1+[("network","raw",0,4)],
 "E,C,D,N2 raw,N2 own1":L1+[("network","raw",0,2),("network","own",1,2)],
 "E,C,D,N4 own10":L1+[("network","own",10,4)],
}
for c in sys.argv[1:]:
  for k,s in specs.items(): print(c,k,run(c,s),flush=True)

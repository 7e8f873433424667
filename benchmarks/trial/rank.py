import sys; sys.path.insert(0,"benchmarks/trial")
from ev import *
def run(cond, spec, omega=0.02, dead=None, verbose=True, only=None):
    data,names,L,az,obj=setup(cond,only)
    parts=[(Part(n,L,obj,az,how,sh),w) for n,how,sh,w in spec]
    spacing=360/np.bincount(obj)[0]
    starts=np.flatnonzero(np.r_[True,np.diff(obj)>0])
    hits=np.zeros(4); tot=0
    for name,_,S in data:
        if name not in names: continue
        t=names.index(name)
        for s in S:
            tot+=1
            for n in (0,1,3):
                st=s["steps"][n]; sup=np.zeros((len(names),BIN))
                for k in range(n+1):
                    Q=st["levels"][k]
                    z=sum(w*p.z(Q) for p,w in parts).max(0)
                    rot=s["steps"][k]["az"]-s["steps"][0]["az"]
                    d=np.abs((az[:,None]-rot-np.arange(BIN)[None]*5+180)%360-180)
                    m=z[:,None]-omega*np.maximum(0,d-spacing/2)
                    sup+=np.maximum.reduceat(m,starts,axis=0)
                hits[n]+= sup.max(1).argmax()==t
    return (hits[[0,1,3]]/tot*100).round(1)
if __name__=="__main__":
    c=sys.argv[1]
    specs={
     "today-ish raw e.6c.4":[("edges","raw",0,.6),("colours","raw",0,.4)],
     "E,C own .3":[("edges","own",.3,1),("colours","own",.3,1)],
     "E,C own 1":[("edges","own",1,1),("colours","own",1,1)],
     "E,C mean":[("edges","mean",0,1),("colours","mean",0,1)],
     "E,C raw":[("edges","raw",0,1),("colours","raw",0,1)],
     "E,C,D own .3,.6":[("edges","own",.3,1),("colours","own",.3,1),("cedd","own",.3,.6)],
     "N raw":[("network","raw",0,1)],
     "N own .3":[("network","own",.3,1)],
     "N own 1":[("network","own",1,1)],
     "E,C own 1,N raw":[("edges","own",1,1),("colours","own",1,1),("network","raw",0,2)],
     "E,C own 1,N own 1":[("edges","own",1,1),("colours","own",1,1),("network","own",1,2)],
     "E,C,D own 1,N raw":[("edges","own",1,1),("colours","own",1,1),("cedd","own",1,.6),("network","raw",0,2)],
    }
    for k,s in specs.items(): print(c,k,run(c,s),flush=True)

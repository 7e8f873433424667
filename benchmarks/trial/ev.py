import pickle, numpy as np, sys
from hbr.descriptors.registry import descriptor
E,Cc,N,D=(descriptor(n) for n in ("edges","colours","network","cedd"))
cols={}
o=0
for d in (E,Cc,N,D): cols[d.name]=slice(o,o+d.length); o+=d.length
def load(c): return pickle.load(open(f"trial/{c}.pkl","rb"))
def entries(name, L):
    L=L[:,cols[name]]
    d={"edges":E,"colours":Cc,"network":N,"cedd":D}[name]
    return d.entries(L)
def unit(X): 
    n=np.linalg.norm(X,axis=1,keepdims=True); return X/np.maximum(n,1e-12)
class White:
    """own whitening with shrinkage"""
    def __init__(s,X,shrink):
        s.m=X.mean(0); Y=X-s.m; Cv=Y.T@Y/max(1,len(X)-1)
        t=np.trace(Cv)/len(Cv); w,V=np.linalg.eigh(Cv); s.W=V/np.sqrt((1-shrink)*0+w+shrink*t)
    def __call__(s,X): return unit((X-s.m)@s.W)
class Plain:
    def __init__(s,X): s.m=X.mean(0)
    def __call__(s,X): return unit(X-s.m)
class Raw:
    def __init__(s,X): pass
    def __call__(s,X): return unit(X)
def is_en(name):  # coil every ninth not enrolled
    return int(name[3:])%9!=0
def setup(cond, only=None):
    """arrays of enrolled views for a condition"""
    data=load(cond); coil=cond.startswith("coil,")
    en=[(n,e) for n,e,_ in data if (not coil or is_en(n)) and (only is None or only(n))]
    names=[n for n,_ in en]
    L=np.concatenate([e[0] for _,e in en]); az=np.concatenate([e[1] for _,e in en])
    obj=np.repeat(np.arange(len(en)),[len(e[1]) for _,e in en])
    return data,names,L,az,obj
class Part:
    def __init__(s,name,L,obj,az,how,shrink=0.3):
        s.name=name; X=entries(name,L)
        s.f={"own":lambda X:White(X,shrink),"mean":Plain,"raw":Raw}[how](X)
        s.U=s.f(X).astype(np.float32)
        # spread of similarities between different objects
        G=s.U@s.U.T; different=obj[:,None]!=obj[None]
        s.mu=float(G[different].mean()); s.sd=float(G[different].std())
    def z(s,Q): return ((s.f(entries(s.name,Q)).astype(np.float32)@s.U.T)-s.mu)/s.sd
BIN=72
def pen_matrix(az,omega): # views x bins penalty
    d=np.abs((az[:,None]-np.arange(BIN)[None]*5+180)%360-180)
    return d

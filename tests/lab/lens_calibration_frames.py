import numpy as np, sys, json, os
from scipy.special import erf, j1
from scipy.interpolate import RectBivariateSpline
N=64; size=0.03; pitch=size/N; noise=1e-6; z=0.036; h=300.
S2=np.sqrt(2)
def gauss1(edges,c,s):
    c0=0.5*(1+erf((edges-c)/(S2*s))); return np.diff(c0)
class Mix:
    """sum of Gaussians, offsets px depend on field"""
    def __init__(self,fn): self.fn=fn
    def pix(self,x,y):
        e=np.arange(N+1.)
        u=(x-N/2)/(N/2); v=(y-N/2)/(N/2)
        out=np.zeros((N,N))
        for w,dx,dy,s in self.fn(u,v): out+=w*np.outer(gauss1(e,y+dy,s),gauss1(e,x+dx,s))
        return out
class Table:
    """pixel-integrated density on a fine grid, interpolated"""
    def __init__(self,dens,R,os=16):
        n=int(R*os); t=(np.arange(-n,n+1))/os
        X,Y=np.meshgrid(t,t); d=dens(X,Y)
        # box integrate by cumulative trapezoid via spline of 2D integral
        sp=RectBivariateSpline(t,t,d,kx=3,ky=3)
        c=np.zeros((len(t),len(t)))
        # antiderivative by cumulative Simpson on spline: use cumsum with Euler-Maclaurin-ish: integrate spline numerically
        from scipy.interpolate import make_interp_spline
        A=make_interp_spline(t,d,k=5,axis=0).antiderivative()(t)
        B=make_interp_spline(t,A,k=5,axis=1).antiderivative()(t)
        self.tot=B[-1,-1]; self.F=RectBivariateSpline(t,t,B/self.tot,kx=5,ky=5); self.R=R-1e-9
    def pix(self,x,y):
        e=np.arange(N+1.)
        ex=np.clip(e-x,-self.R,self.R); ey=np.clip(e-y,-self.R,self.R)
        # evaluate at unique sorted
        ux,ix=np.unique(ex,return_inverse=True); uy,iy=np.unique(ey,return_inverse=True)
        G=self.F(uy,ux)[np.ix_(iy,ix)]
        return np.diff(np.diff(G,axis=0),axis=1)
def radial_airy(r0):
    def f(X,Y):
        r=np.hypot(X,Y)/r0*3.8317; r=np.where(r==0,1e-9,r); return (2*j1(r)/r)**2
    return f
def kinds():
    k={}
    k['gauss']=(Mix(lambda u,v:[(1,0,0,1.6)]),1.6)
    k['gausswide']=(Mix(lambda u,v:[(1,0,0,1.9)]),1.6)
    k['airy']=(Table(radial_airy(4.0),40),1.6)
    k['moffat']=(Table(lambda X,Y:(1+(X*X+Y*Y)/2.8**2)**-2.5,45),1.7)
    def disc(X,Y):
        r=np.hypot(X,Y); return 1/(1+np.exp((r-3.5)/0.45))
    k['defocus']=(Table(disc,14),1.9)
    k['coma']=(Mix(lambda u,v:[(.55,0,0,1.3),(.3,1.6*u,1.6*v,1.8),(.15,3.2*u,3.2*v,2.4)]),1.6)
    c=np.cos(np.pi/4)
    a,b=2.5,1.8
    def ast(X,Y):
        p=(X+Y)*c; q=(X-Y)*c; return np.exp(-.5*(p/a)**2-.5*(q/b)**2)
    k['astig']=(Table(ast,25),2.1)
    k['ghost']=(Mix(lambda u,v:[(.98,0,0,1.6),(.02,5.0,3.0,2.0)]),1.6)
    return k
def make(name,psf,sigma,snr,T,seed,out,truth,nspots=6,sep=9.,static=False):
    rng=np.random.default_rng(seed)
    frames=np.zeros((T,N,N)); tr=[]
    peak0=psf.pix(N/2-.5+.5,N/2+.0).max()
    fixed=None
    for t in range(T):
        pos=[]
        while len(pos)<nspots:
            p=rng.uniform(4,N-4,2)
            if all(np.hypot(*(p-q))>sep for q in pos): pos.append(p)
        if static:
            if fixed is None: fixed=pos
            pos=fixed
        # smallest allowed separation given
        es=snr*noise/peak0*rng.uniform(.7,1.4,nspots)
        f=rng.normal(0,noise,(N,N)); J=[];
        for p,e in zip(pos,es):
            q=psf.pix(*p); f+=e*q
            if truth:
                d=1e-3
                J+= [e*(psf.pix(p[0]+d,p[1])-psf.pix(p[0]-d,p[1]))/(2*d), e*(psf.pix(p[0],p[1]+d)-psf.pix(p[0],p[1]-d))/(2*d), e*q]
        frames[t]=f
        if truth:
            J=np.array([j.ravel() for j in J])/noise
            C=np.linalg.inv(J@J.T)
            tr.append(dict(px=[list(map(float,p)) for p in pos],e=[float(e) for e in es],crb_px2=[float(C[3*k,3*k]+C[3*k+1,3*k+1]) for k in range(nspots)]))
    np.save(out+'.npy',frames)
    if truth: json.dump(tr,open(out+'.json','w'))
if __name__=='__main__':
    D='./lens-data/'
    for name,(psf,sigma) in kinds().items():
        if len(sys.argv)>1 and name not in sys.argv[1].split(','): continue
        for snr in [30,100,300,1000]:
            make(name,psf,sigma,snr,150,1,D+f'{name}-{snr}-cal',False)
            make(name,psf,sigma,snr,60,2,D+f'{name}-{snr}-test',True)
        open(D+f'{name}.sigma','w').write(str(sigma))
